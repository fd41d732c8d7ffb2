"""One HTML page from headings, texts, tables and pictures, which loads nothing from elsewhere."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence

STYLE = """
:root { --ink: #1b1f24; --soft: #5b6570; --line: #d9dee3; --warn: #8a4b00; --pale: #fff4e0; }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--ink);
       max-width: 72rem; margin: 0 auto; padding: 2rem; }
h1 { font-size: 1.7rem; margin: 0 0 .3rem; }
h2 { font-size: 1.25rem; margin: 2.2rem 0 .6rem; border-bottom: 1px solid var(--line); }
h3 { font-size: 1.05rem; margin: 1.4rem 0 .4rem; }
p { margin: .4rem 0; max-width: 48rem; }
nav a { margin-right: 1.2rem; }
.soft, figcaption { color: var(--soft); font-size: .9rem; }
.warning { color: var(--warn); background: var(--pale); border-left: 4px solid;
           padding: .4rem .8rem; margin: .5rem 0; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; margin: .6rem 0; font-variant-numeric: tabular-nums; }
th, td { text-align: left; vertical-align: top; padding: .25rem .9rem .25rem 0;
         border-bottom: 1px solid var(--line); }
tbody th { font-weight: 400; }
thead th { color: var(--soft); font-weight: 600; }
.pictures { display: flex; flex-wrap: wrap; gap: 1rem; align-items: flex-start; }
figure { margin: .4rem 0; max-width: 100%; }
img { max-width: 100%; height: auto; border: 1px solid var(--line); border-radius: 4px; background: #fff; }
pre { background: #f5f7f9; padding: .8rem; overflow-x: auto; font-size: .85rem; border-radius: 4px; }
@media print { body { padding: 0; max-width: none; } figure, table { break-inside: avoid; } }
"""

HEAD = (
    '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
    '<meta name="viewport" content="width=device-width, initial-scale=1">\n<title>'
)
"""What comes before a page's title."""


class Page:
    """A page that grows from the top; every text is escaped."""

    def __init__(self, title: str, subtitle: str = "") -> None:
        """Begin with a title and a line below it."""
        self._title = title
        self._parts = [f"<h1>{html.escape(title)}</h1>"]
        self._chapters: list[str] = []
        if subtitle:
            self._parts.append(f'<p class="soft">{html.escape(subtitle)}</p>')

    def chapter(self, title: str) -> None:
        """Begin a chapter, which the list of contents names."""
        self._parts.append(f'<h2 id="c{len(self._chapters)}">{html.escape(title)}</h2>')
        self._chapters.append(title)

    def section(self, title: str) -> None:
        """Begin a section of a chapter."""
        self._parts.append(f"<h3>{html.escape(title)}</h3>")

    def text(self, sentence: str, *, soft: bool = False) -> None:
        """A paragraph; `soft` for remarks."""
        kind = ' class="soft"' if soft else ""
        self._parts.append(f"<p{kind}>{html.escape(sentence)}</p>")

    def warning(self, sentence: str) -> None:
        """A paragraph that must not be overlooked."""
        self._parts.append(f'<p class="warning">{html.escape(sentence)}</p>')

    def table(self, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """A table; its first column names the rows."""
        head = "".join(f"<th>{html.escape(cell)}</th>" for cell in header)
        body = "".join(
            f"<tr><th>{html.escape(row[0])}</th>"
            + "".join(f"<td>{html.escape(cell)}</td>" for cell in row[1:])
            + "</tr>"
            for row in rows
        )
        self._parts.append(
            f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
        )

    def pictures(self, captioned: Mapping[str, bytes]) -> None:
        """PNG or JPEG pictures side by side, by their captions."""
        figures = "".join(
            f'<figure><img alt="{html.escape(caption)}" src="{_data(content)}">'
            f"<figcaption>{html.escape(caption)}</figcaption></figure>"
            for caption, content in captioned.items()
        )
        self._parts.append(f'<div class="pictures">{figures}</div>')

    def listing(self, text: str) -> None:
        """Text as it is, such as settings."""
        self._parts.append(f"<pre>{html.escape(text)}</pre>")

    def html(self) -> str:
        """The whole document."""
        links = "".join(
            f'<a href="#c{number}">{html.escape(title)}</a>' for number, title in enumerate(self._chapters)
        )
        first, *rest = self._parts
        body = "\n".join([first, f"<nav>{links}</nav>", *rest] if len(self._chapters) > 1 else self._parts)
        return (
            f"{HEAD}{html.escape(self._title)}</title>\n<style>{STYLE}</style>\n</head>\n"
            f"<body>\n{body}\n</body>\n</html>\n"
        )


def _data(picture: bytes) -> str:
    kind = "png" if picture.startswith(b"\x89PNG") else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(picture).decode()}"
