"""`voxscene bench speed`: hypotheses rendered and scored a second. Runs with jax, numpy and click alone."""

from __future__ import annotations

from typing import Any

import click

from pipeline.options import Common, common_options


@click.command(name="speed")
@common_options(computes=True)
def command(common: Common) -> None:
    """Hypotheses rendered and scored a second, against Embree.

    By image side, objects and voxels. Random distinct poses, results consumed; compile time apart. The
    object's circle spans a third of the image's side. Takes about two minutes.
    """
    from pipeline.benchmarks.speed import measure_speed
    from pipeline.quiet_stdout import stdout_to_stderr

    with common.progress("speed", "figures") as progress, stdout_to_stderr():
        document = measure_speed(common.seed, progress)
    common.report(document, _lines(document))


def _lines(document: dict[str, Any]) -> list[str]:
    lines = [
        f"on {document['device']}, a second, median (least to most):",
        f"{'image side':<28}{'voxscene':>30}{'Embree, whole image':>30}{'Embree, under the sphere':>30}",
    ]
    for side, rate in document["spread"]["hypotheses_per_second"].items():
        peer = document["embree"][side]
        cells = [_cell(rate), _cell(peer.get("whole_image")), _cell(peer.get("under_sphere"))]
        lines.append(f"{side + ' px':<28}" + "".join(f"{cell:>30}" for cell in cells))
    for side, rate in document["spread"]["layers_per_second"].items():
        lines.append(f"{side + ' px, layers alone':<28}{_cell(rate):>30}")
    for side, roof in document["roofline"].items():
        lines.append(
            f"{side + ' px, no more than':<28}{roof['bound_per_second']:>30,.0f}  "
            f"{roof['covered_pixels']:.0f} pixels covered, {roof['bytes'] / 1e3:.1f} kB, "
            f"{roof['operations'] / 1e3:.0f} thousand operations; "
            f"{roof['lookups_per_second'] / 1e6:.0f} M look-ups, {roof['densities_per_second'] / 1e6:.0f} M "
            f"densities, {roof['scatters_per_second'] / 1e6:.0f} M scatters a second"
        )
        lines.append(
            f"{side + ' px, by sphere tracing':<28}{roof['tracing_bound_per_second']:>30,.0f}  "
            f"{roof['looks']:.0f} looks for {roof['cast_pixels']:.0f} pixels cast; "
            f"{roof['looks_per_second'] / 1e6:.0f} M looks a second"
        )
    skipped = [peer["skipped"] for peer in document["embree"].values() if "skipped" in peer]
    lines += [f"Embree: {skipped[0]}"] if skipped else []
    growth = document["growth"]
    for title, key in (
        ("one of {} objects moved", "objects_one_moved_per_second"),
        ("{} voxels", "voxels_per_second"),
    ):
        lines += [
            f"{title.format(size) + ', 100 px':<28}{_cell(rate):>30}" for size, rate in growth[key].items()
        ]
    lines.append(
        f"largest kernel: {document['compile_s']:.1f} s at first; kept from an earlier run, "
        f"{document['compile_cached_s']:.2f} s after {document['trace_s']:.2f} s of tracing"
    )
    return lines


def _cell(rate: dict[str, float] | None) -> str:
    if rate is None:
        return "-"
    return f"{rate['median']:,.0f} ({rate['least']:,.0f} to {rate['most']:,.0f})"
