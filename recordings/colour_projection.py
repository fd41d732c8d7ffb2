"""Colour from a camera beside the depth camera: every depth pixel is looked up where that camera saw it.

A point X of the depth camera is at T X in the colour camera, whose lens puts it on one pixel. Points that
something nearer hides from the colour camera get no colour.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recordings.cameras.distortion import (
    check_distortion,
    distortion_model,
    is_distorted,
    unfolded_radius,
)
from recordings.cameras.matching import (
    is_frame,
    is_rectified,
    matching_camera,
    namespace,
    shared_namespace,
)
from recordings.cameras.pinhole import UnusableCamera, stored_intrinsics
from recordings.first_colour import first_colour
from recordings.images.colour import ColourMessage, colour_size, rgb_of_size
from recordings.messages.decoded_bag import DecodedBag
from recordings.messages.types import (
    CameraMessage,
    ExtrinsicsMessage,
    UndecodableMessage,
)
from recordings.poses.transform_tree import TransformTree, recorded_transforms
from recordings.types import NO_RETURN, CameraIntrinsics

_NEAREST_M = 1e-3
"""Points nearer to the colour camera's plane than this project nowhere."""
_DISTANT_M = 100.0
"""Beyond this no depth camera measures: the smallest inverse depth that is told from none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ColourCamera:
    """A topic of colour images, the lens that took them and where it sits.

    Attributes:
        name: of the topic.
        intrinsics: of the stored images, before their distortion.
        model: name of the distortion model; "" without distortion.
        coefficients: of the model.
        colour_from_depth: (4, 4) rigid transform from the depth camera.
        depth_intrinsics: of the depth images.
    """

    name: str
    intrinsics: CameraIntrinsics
    model: str
    coefficients: tuple[float, ...]
    colour_from_depth: NDArray[np.float64]
    depth_intrinsics: CameraIntrinsics

    def rgb(
        self, message: ColourMessage, depth_m: NDArray[np.float32]
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """The colours (H, W, 3) of a depth image's pixels, black where unknown; and (H, W) where known.

        Raises:
            UndecodableMessage: the image is damaged, or of another size than the first.
        """
        image = rgb_of_size(message, (self.intrinsics.width, self.intrinsics.height))
        v, u = np.nonzero(depth_m != NO_RETURN)
        points = (self.depth_intrinsics.rays(u, v) * depth_m[v, u, None]) @ self.colour_from_depth[:3, :3].T
        points += self.colour_from_depth[:3, 3]
        row, column, shown = self._pixels(points)
        shown[shown] = ~self._hidden(row[shown], column[shown], points[shown, 2])
        rgb = np.zeros((*depth_m.shape, 3), np.uint8)
        known = np.zeros(depth_m.shape, np.bool_)
        rgb[v[shown], u[shown]] = image[row[shown], column[shown]]
        known[v[shown], u[shown]] = True
        return rgb, known

    def _pixels(
        self, points_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
        """Row and column (N,) of points (N, 3) in the colour camera, and whether they lie in its image."""
        camera = self.intrinsics
        ahead = points_m[:, 2] > _NEAREST_M
        x, y = (points_m[:, :2] / np.where(ahead, points_m[:, 2], 1.0)[:, None]).T
        if self.model:
            distort = distortion_model(self.model)
            radius = np.hypot(x, y)
            corner = float(np.hypot(camera.width / camera.fx, camera.height / camera.fy))
            with np.errstate(all="ignore"):  # a rational model may have poles far outside the image
                ahead &= radius < unfolded_radius(distort, self.coefficients, corner)
                x, y = distort(x, y, self.coefficients)
        u, v = camera.fx * x + camera.cx, camera.fy * y + camera.cy
        with np.errstate(invalid="ignore"):
            shown = ahead & (np.abs(u - camera.width / 2 + 0.5) < camera.width / 2)
            shown &= np.abs(v - camera.height / 2 + 0.5) < camera.height / 2
        column, row = (np.rint(np.where(shown, each, 0)).astype(np.intp) for each in (u, v))
        shown &= (row < camera.height) & (column < camera.width)
        return row, column, shown

    def _hidden(
        self, row: NDArray[np.intp], column: NDArray[np.intp], z_m: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Which of the points (N,) at pixels of the colour image stand behind another.

        A buffer of inverse depths, every point as wide as its depth pixel. What is nearer hides a point if
        their disparities between the two cameras differ by more than a pixel: below that, the colour that
        is looked up is at most a pixel off, and a slanted surface, whose neighbouring pixels differ by less,
        never hides itself.
        """
        inverse = 1 / np.minimum(z_m, _DISTANT_M)
        buffer = np.zeros((self.intrinsics.height, self.intrinsics.width))
        far_first = np.argsort(inverse)  # of points on one pixel the last, the nearest, stays
        buffer[row[far_first], column[far_first]] = inverse[far_first]
        pixel_width = self.intrinsics.fx / self.depth_intrinsics.fx
        buffer = _largest_within(buffer, int(np.ceil(pixel_width / 2)))
        baseline_m = float(np.linalg.norm(self.colour_from_depth[:3, 3]))
        focal_px = min(self.intrinsics.fx, self.depth_intrinsics.fx)
        return (buffer[row, column] - inverse) * baseline_m * focal_px > 1.0


def projected_colour(
    decoded: DecodedBag,
    depth_topic: str,
    frame_id: str,
    depth_intrinsics: CameraIntrinsics,
    cameras: dict[str, CameraMessage],
) -> ColourCamera | None:
    """The nearest topic, by name, of colour images whose camera and mounting are both recorded, if any.

    Args:
        decoded: the recording.
        depth_topic: the depth images' topic.
        frame_id: the frame that they were taken in.
        depth_intrinsics: their camera.
        cameras: a usable message of each camera topic.
    """
    tree: TransformTree | None = None
    for topic in sorted(decoded.topic_names, key=lambda name: (-shared_namespace(depth_topic, name), name)):
        first = first_colour(decoded, topic)
        # One in the depth's frame, yet not registered, is another camera that carries the wrong name.
        if first is None or is_frame(first.frame_id, frame_id):
            continue
        tree = tree or recorded_transforms(decoded, mountings_only=True)
        colour_from_depth = tree.mounting(first.frame_id, frame_id)
        if colour_from_depth is None:
            colour_from_depth = _drivers_extrinsics(decoded, depth_topic, topic)
        if colour_from_depth is None:
            continue
        lens = _lens(topic, first, cameras)
        if lens is not None:
            intrinsics, model, coefficients = lens
            return ColourCamera(
                name=topic,
                intrinsics=intrinsics,
                model=model,
                coefficients=coefficients,
                colour_from_depth=colour_from_depth,
                depth_intrinsics=depth_intrinsics,
            )
    return None


def _drivers_extrinsics(
    decoded: DecodedBag, depth_topic: str, colour_topic: str
) -> NDArray[np.float64] | None:
    """colour_from_depth (4, 4) of a driver's topic, if there is one: /camera/extrinsics/depth_to_color.

    Its name tells the two cameras by the last part of their topics' namespaces.
    """
    depth, colour = namespace(depth_topic), namespace(colour_topic)
    if not (depth and colour):
        return None
    for name in decoded.topic_names:
        beside = min(shared_namespace(name, depth_topic), shared_namespace(name, colour_topic))
        if name.endswith(f"/{depth[-1]}_to_{colour[-1]}") and beside == len(depth) - 1 == len(colour) - 1:
            message = decoded.first(name)
            if isinstance(message, ExtrinsicsMessage):
                return message.second_from_first
    return None


def _lens(
    topic: str, first: ColourMessage, cameras: dict[str, CameraMessage]
) -> tuple[CameraIntrinsics, str, tuple[float, ...]] | None:
    """Intrinsics and distortion of a topic's own camera; None where it is not recorded or of no use."""
    own_frame = {name: one for name, one in cameras.items() if is_frame(one.frame_id, first.frame_id)}
    rectified = is_rectified(topic)
    try:
        size = colour_size(first)
        found = matching_camera(topic, first.frame_id, size, own_frame)
        if found is None:
            return None
        camera = found[1]
        intrinsics = stored_intrinsics(camera, *size, rectified=rectified)
        if rectified or not is_distorted(camera.distortion):
            return intrinsics, "", ()
        check_distortion(camera.distortion_model, camera.distortion)
    except (UndecodableMessage, UnusableCamera):
        return None
    return intrinsics, camera.distortion_model, camera.distortion


def _largest_within(values: NDArray[np.float64], radius: int) -> NDArray[np.float64]:
    """The largest of the values (H, W) up to `radius` rows and columns away."""
    for axis in (0, 1):
        largest = values.copy()
        for step in range(1, radius + 1):
            ahead, behind = [slice(None)] * 2, [slice(None)] * 2
            ahead[axis], behind[axis] = slice(step, None), slice(None, -step)
            np.maximum(largest[tuple(behind)], values[tuple(ahead)], out=largest[tuple(behind)])
            np.maximum(largest[tuple(ahead)], values[tuple(behind)], out=largest[tuple(ahead)])
        values = largest
    return values
