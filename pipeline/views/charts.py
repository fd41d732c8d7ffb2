"""Small pictures beside the views: what colours mean, and presence as bars (Pillow draws them)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from pipeline.colours import BACKGROUND, INFERRED, LOST, PATH, SEEN, TRUTH, UNSEEN
from pipeline.publishing.told_spread import position_text
from pipeline.views.rendered_depth import DIFFERENCE_MM, difference_colours

INK, FAINT = (235, 235, 235), (70, 76, 88)
LETTER_PX, LINE_PX, MARGIN_PX = 15, 26, 12
BAR_PX = 180
WIDTH_PX, NARROW_PX = 580, 440
BAR_LEFT_PX, SHORT_PX, NAME_LETTERS = 180, 100, 22
MOST_BARS = 9
"""More cannot be read in the panel; all that was found is shown."""
Colour = tuple[int, int, int]


def legend(
    depth_range_m: tuple[float, float], *, residual: bool, path: bool, shape: bool, truth: bool = False
) -> NDArray[np.uint8]:
    """What the colours of a run's views mean (h, w, 3).

    Args:
        depth_range_m: at which the colours of depth images begin and end.
        residual: images of the difference of depths are shown.
        path: a trajectory is drawn.
        shape: a learned shape is drawn.
        truth: so are the true path and objects.
    """
    rows: list[tuple[str, Sequence[tuple[str, Colour]] | NDArray[np.uint8], tuple[str, str]]] = []
    low, high = depth_range_m
    rows.append(("depth", depth_colours(np.linspace(0, 1, BAR_PX)), (f"{low:.2g} m", f"{high:.2g} m")))
    if residual:
        signed = difference_colours(np.linspace(-1, 1, BAR_PX)).astype(np.uint8)
        ends = f"-{DIFFERENCE_MM:.0f} mm (nearer)", f"+{DIFFERENCE_MM:.0f} mm (farther)"
        rows.append(("residual", signed, ends))
    if path:
        rows.append(("camera", [("mean path, drawn trajectories", PATH), ("lost frames", LOST)], ("", "")))
    if truth:
        rows.append(("truth", [("true path, boxes of true objects", TRUTH)], ("", "")))
    if shape:
        rows.append(("surface", [("seen", SEEN), ("inferred", INFERRED), ("never seen", UNSEEN)], ("", "")))
    image, draw = _canvas(len(rows))
    for row, (title, content, (low_text, high_text)) in enumerate(rows):
        top = MARGIN_PX + row * LINE_PX
        draw.text((MARGIN_PX, top), title, INK, _font())
        left = 120
        if isinstance(content, np.ndarray):
            left = _text(draw, left, top, low_text)
            image.paste(Image.fromarray(np.repeat(content[None], 14, axis=0)), (left, top + 2))
            _text(draw, left + BAR_PX + 8, top, high_text)
            continue
        for text, colour in content:
            draw.rectangle((left, top + 2, left + 14, top + 16), colour)
            left = _text(draw, left + 22, top, text) + 12
    return np.asarray(image)


def presence_bars(parse: Mapping[str, Any], colours: Mapping[str, Colour]) -> NDArray[np.uint8]:
    """A bar for each object of summary.json that was looked for (h, w, 3), the likeliest first.

    Of many that were not found the likeliest.

    Args:
        parse: of summary.json.
        colours: of the objects that were found, by name.
    """
    every = sorted([*parse["objects"], *parse["not_found"]], key=lambda one: -_share(one))
    shown = every[: max(MOST_BARS, len(parse["objects"]))]
    rest = every[len(shown) :]
    image, draw = _canvas(len(shown) + bool(rest), NARROW_PX)
    if rest:
        most = f"{len(rest)} more, at most {_share(rest[0]):.0%}"
        draw.text((MARGIN_PX, MARGIN_PX + len(shown) * LINE_PX), most, INK, _font())
    for row, one in enumerate(shown):
        top = MARGIN_PX + row * LINE_PX
        draw.text((MARGIN_PX, top), one["name"][:NAME_LETTERS], INK, _font())
        draw.rectangle((BAR_LEFT_PX, top + 2, BAR_LEFT_PX + SHORT_PX, top + 16), FAINT)
        end = BAR_LEFT_PX + round(SHORT_PX * _share(one))
        draw.rectangle((BAR_LEFT_PX, top + 2, end, top + 16), colours.get(one["name"], INK))
        draw.text((BAR_LEFT_PX + SHORT_PX + 8, top), _bar_text(one), INK, _font())
    return np.asarray(image)


def _share(one: Mapping[str, Any]) -> float:
    """Presence as a share of the bar, also where it is no number."""
    return min(max(one["presence"] or 0.0, 0.0), 1.0)


def _bar_text(one: Mapping[str, Any]) -> str:
    """Presence and spread, with a question mark where chains do not agree on it."""
    if "middle_std_m" not in one:
        return f"{_share(one):.0%}"
    return f"{_share(one):.0%}, {position_text(one)}{'' if one['converged'] else '?'}"


def depth_colours(shares: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Rerun's turbo (..., 3) of shares (...) of the range, by its authors' polynomial (Mikhailov, 2019)."""
    powers = np.stack([np.asarray(shares, float) ** power for power in range(6)], axis=-1)
    return (255 * np.clip(powers @ _TURBO, 0, 1)).astype(np.uint8)


_TURBO = np.array(
    [
        [0.13572138, 0.09140261, 0.10667330],
        [4.61539260, 2.19418839, 12.64194608],
        [-42.66032258, 4.84296658, -60.58204836],
        [132.13108234, -14.18503333, 110.36276771],
        [-152.94239396, 4.27729857, -89.90310912],
        [59.28637943, 2.82956604, 27.34824973],
    ]
)


def _canvas(rows: int, width: int = WIDTH_PX) -> tuple[Image.Image, ImageDraw.ImageDraw]:
    image = Image.new("RGB", (width, 2 * MARGIN_PX + max(rows, 1) * LINE_PX), BACKGROUND)
    return image, ImageDraw.Draw(image)


def _text(draw: ImageDraw.ImageDraw, left: int, top: int, text: str) -> int:
    """Write a text; gives where the next thing may begin."""
    draw.text((left, top), text, INK, _font())
    return left + round(draw.textlength(text, _font())) + 8


def _font() -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(LETTER_PX)
