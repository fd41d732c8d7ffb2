"""Attachments become files again, or one line says which cannot."""

import pytest

from recordings.attached import save_attachments
from recordings.errors import RecordingError
from recordings.writer import RecordingWriter


def write(path, names):
    """A recording with attachments of these names; each holds its number."""
    with RecordingWriter(path) as writer:
        for number, name in enumerate(names):
            writer.write_attachment(name, "text/plain", b"%d" % number, 0)


def test_attachments_are_saved_under_their_names(recording_path, tmp_path):
    """Folders in names become folders."""
    write(recording_path, ["slam.npz", "shapes/mug.npz"])
    saved = save_attachments(recording_path, tmp_path / "out")
    assert {path.relative_to(tmp_path / "out").as_posix(): path.read_bytes() for path in saved} == {
        "slam.npz": b"0",
        "shapes/mug.npz": b"1",
    }


@pytest.mark.parametrize(
    ("names", "complaint"),
    [
        (["../a"], r"named '../a': no file's name"),
        (["/a"], r"named '/a': no file's name"),
        ([""], r"named '': no file's name"),
        (["a\0b"], r"named 'a\\x00b': no file's name"),
        (["a.npz", "b.npz", "a.npz"], r"holds two attachments named 'a.npz'"),
        (["a", "a/b"], r"cannot write .*out/a/b: "),
        (["a" * 300], r"cannot write .*out/a+: "),
    ],
)
def test_a_name_that_cannot_be_a_file_is_told_in_one_line(names, complaint, recording_path, tmp_path):
    """Names that lead elsewhere, that are another's, and what the file system refuses."""
    write(recording_path, names)
    with pytest.raises(RecordingError, match=complaint) as raised:
        save_attachments(recording_path, tmp_path / "out")
    assert "\n" not in str(raised.value)
