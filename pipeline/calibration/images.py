"""What depth images of one camera tell of its sensor: noise, correlation, and the unknown layer's weights."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.machine import versions
from recordings.sensor_profile import ProfileSource, SensorProfile, UnknownTable
from recordings.types import CameraIntrinsics, DepthNoise

if TYPE_CHECKING:
    from recordings.reading import McapRecording
    from shapes.calibration.noise_estimate import NoiseEstimate
    from shapes.calibration.smooth_windows import WindowResiduals

RUN_FRAMES = 12
"""Of a recording from which a run learns its sensor: two kitchens' halves agree on sigma to 2% by as many."""

STEP_RATIO = 1.5
"""Between the steps at which the unknown layer is learnt for others, whose images may be smaller."""


@dataclass(kw_only=True)
class SensorImages:
    """Depth images of one camera; grows by some hundred kilobytes an image.

    Attributes:
        intrinsics: of the images.
        strides: steps in pixels at which the unknown layer is learnt.
        windows: small windows, by image.
        pixels: every stride-th pixel, by stride and image.
    """

    intrinsics: CameraIntrinsics
    strides: tuple[int, ...]
    windows: list[WindowResiduals] = field(default_factory=list)
    pixels: dict[int, list[NDArray[np.float32]]] = field(default_factory=dict)

    @classmethod
    def for_runs(cls, intrinsics: CameraIntrinsics) -> SensorImages:
        """For recordings of this size alone."""
        from scene.observation.pixel_window import stride_of

        return cls(intrinsics=intrinsics, strides=(stride_of(intrinsics),))

    @classmethod
    def for_others(cls, intrinsics: CameraIntrinsics) -> SensorImages:
        """For images of other sizes, too."""
        from scene.observation.pixel_window import stride_of

        stride = stride_of(intrinsics)
        near = (max(1, round(stride / STEP_RATIO)), stride, round(stride * STEP_RATIO))
        return cls(intrinsics=intrinsics, strides=tuple(sorted(set(near))))

    def __len__(self) -> int:
        """Images so far."""
        return len(self.windows)

    def add(self, depth_m: NDArray[np.float32]) -> None:
        """One image (H, W) more."""
        from scene.observation.pixel_window import compared
        from shapes.calibration.smooth_windows import WindowResiduals

        self.windows.append(WindowResiduals.of(depth_m, self.intrinsics))
        for stride in self.strides:
            rows, columns = compared(depth_m.shape, stride)
            self.pixels.setdefault(stride, []).append(depth_m[np.ix_(rows, columns)])

    def noise(self) -> NoiseEstimate:
        """The sensor's noise."""
        from shapes.calibration.noise_estimate import estimate_noise
        from shapes.calibration.smooth_windows import WindowResiduals

        return estimate_noise(WindowResiduals.together(self.windows))

    def unknown(self, noise: DepthNoise) -> UnknownTable:
        """How well pixels foretell each other, in standard deviations of a noise."""
        from scene.likelihood.unknown_surfaces import REACH_M, UnknownWeights

        learned = [UnknownWeights.learned(self.pixels[stride], noise) for stride in self.strides]
        return UnknownTable(
            pitches_rad=np.array(self.strides) / self.intrinsics.fx,
            weights=np.stack([np.asarray(one.weights, np.float64) for one in learned]),
            scales=np.stack([np.asarray(one.scales, np.float64) for one in learned]),
            reach_m=REACH_M,
        )

    def profile(self, recordings: Sequence[str], known: SensorProfile | None = None) -> SensorProfile:
        """All that they tell.

        Args:
            recordings: where they come from.
            known: of the sensor before; what it says stays as it is.
        """
        known = known or SensorProfile(intrinsics=self.intrinsics)
        noise, correlation = known.noise, known.correlation
        if noise is None:
            found = self.noise()
            noise, correlation = found.noise, found.correlation
        return SensorProfile(
            intrinsics=self.intrinsics,
            noise=noise,
            correlation=correlation,
            distortion=known.distortion,
            unknown=known.unknown or self.unknown(noise),
            source=ProfileSource(
                recordings=tuple(recordings),
                frames=len(self),
                version=versions().get("voxscene", "unknown"),
            ),
        )


def spread_evenly(total: int, most: int) -> list[int]:
    """At most so many numbers of frames, evenly from the first to the last."""
    return np.unique(np.linspace(0, max(total - 1, 0), min(total, most)).round().astype(int)).tolist()


def profile_of(
    recording: McapRecording, total: int, on_frame: Callable[[int, int], None] | None = None
) -> SensorProfile:
    """What a run knows of a recording's sensor: what the user gave, and what was not given by its own frames.

    Args:
        recording: the frames.
        total: number of its frames.
        on_frame: called with frames done and in all.

    Raises:
        ValueError: it has no frame.
    """
    given = recording.sensor
    if given is not None and given.noise is not None and given.unknown is not None:
        return given
    images, numbers = SensorImages.for_runs(recording.intrinsics), spread_evenly(total, RUN_FRAMES)
    add_frames(images, (frame.depth_m for frame in recording.chosen(set(numbers))), len(numbers), on_frame)
    if not len(images):
        raise ValueError("it has no depth frame")
    return images.profile([recording.decoded.bag.path.name], given)


def add_frames(
    images: SensorImages,
    depths_m: Iterable[NDArray[np.float32]],
    count: int,
    on_frame: Callable[[int, int], None] | None,
) -> None:
    """Take in images (H, W), telling how far it is."""
    for done, depth_m in enumerate(depths_m, start=1):
        images.add(depth_m)
        if on_frame is not None:
            on_frame(done, count)
