import jax.numpy as jnp
import numpy as np

from recordings.types import CameraIntrinsics
from shapes.geometry.camera import Camera, pixel_rays, project

INTRINSICS = CameraIntrinsics(width=31, height=17, fx=40.0, fy=42.0, cx=14.2, cy=8.9)


def test_projection_undoes_unprojection() -> None:
    """Every pixel's point projects onto the pixel's integer centre."""
    camera = Camera.from_intrinsics(INTRINSICS)
    depth_m = jnp.linspace(0.4, 3.0, 17 * 31).reshape(17, 31)

    rays = pixel_rays(camera, 17, 31)
    points = (rays * depth_m[..., None]).reshape(-1, 3)
    pixels = jnp.stack(project(camera, *points.T), axis=-1)

    rows, columns = np.mgrid[:17, :31]
    np.testing.assert_allclose(rays, INTRINSICS.rays(columns, rows), atol=1e-6)
    np.testing.assert_allclose(pixels[:, 0], columns.ravel(), atol=1e-4)
    np.testing.assert_allclose(pixels[:, 1], rows.ravel(), atol=1e-4)


def test_resizing_keeps_the_rays_of_the_image_corners() -> None:
    """The outer corner of the corner pixels, half a pixel outside the centres, keeps its direction."""
    doubled = INTRINSICS.resized(62, 34)

    def corner(camera: CameraIntrinsics) -> tuple[float, float]:
        return (
            (camera.width - 0.5 - camera.cx) / camera.fx,
            (camera.height - 0.5 - camera.cy) / camera.fy,
        )

    np.testing.assert_allclose(corner(doubled), corner(INTRINSICS))
