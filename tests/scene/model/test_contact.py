import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from scene.model import contact
from scene.model.contact import Contact, contact_from_poses, face_contact, pose_from_contact, relative_box
from shapes.geometry.rotation_densities import hopf_coordinates, rotation_from_hopf, uniform_rotation


def random_poses(key: jax.Array, count: int) -> jax.Array:
    """Poses (n, 7) within half a metre."""
    rotation_key, position_key = jax.random.split(key)
    rotations = jax.jit(jax.vmap(uniform_rotation))(jax.random.uniform(rotation_key, (count, 3)))
    return jnp.concatenate([rotations, 0.5 * jax.random.normal(position_key, (count, 3))], axis=1)


def test_hopf_chart_inverts(key: jax.Array) -> None:
    """Rotation to (eta, phi) and back is the same rotation, also next to the branch of phi."""
    wxyz = random_poses(key, 2000)[:, :4]
    near = wxyz.at[:500, 3].set(1e-9)
    wxyz = near / jnp.linalg.norm(near, axis=1, keepdims=True)

    back = jax.jit(jax.vmap(lambda q: rotation_from_hopf(*hopf_coordinates(q))))(wxyz)

    np.testing.assert_allclose(np.abs(jnp.sum(wxyz * back, axis=1)), 1.0, atol=1e-12)


def test_hopf_chart_carries_the_pole(key: jax.Array) -> None:
    """Eta is where the rotation carries the north pole, and phi = 0 is the shortest way there."""
    wxyz = random_poses(key, 100)[:, :4]
    eta, _ = jax.jit(jax.vmap(hopf_coordinates))(wxyz)
    carried = jax.jit(jax.vmap(lambda q: jaxlie.SO3(q).apply(jnp.array([0.0, 0, 1]))))(wxyz)
    shortest = jax.jit(jax.vmap(lambda e: jaxlie.SO3(rotation_from_hopf(e, jnp.zeros(()))).log()))(eta)

    np.testing.assert_allclose(eta, carried, atol=1e-12)
    np.testing.assert_allclose(jnp.linalg.norm(shortest, axis=1), jnp.arccos(eta[:, 2]), atol=1e-7)


def test_hopf_chart_has_the_factor_eight(key: jax.Array) -> None:
    """|det| from S^2 x S^1 is 1/8 to quaternion arcs and 1 to jaxlie's angle tangent (supplement O.6.4)."""

    def determinants(wxyz: jax.Array) -> tuple[jax.Array, jax.Array]:
        eta, phi = hopf_coordinates(wxyz)
        tangent = jnp.linalg.svd(eta[None])[2][1:]

        def rotation(step: jax.Array) -> jax.Array:
            moved = eta + step[0] * tangent[0] + step[1] * tangent[1]
            return rotation_from_hopf(moved / jnp.linalg.norm(moved), phi + step[2])

        def angle_tangent(step: jax.Array) -> jax.Array:
            here = jaxlie.SO3(rotation(jnp.zeros(3)))
            return (here.inverse() @ jaxlie.SO3(rotation(step))).log()

        arcs = jax.jacfwd(rotation)(jnp.zeros(3))
        angles = jax.jacrev(angle_tangent)(jnp.full(3, 1e-6))
        return jnp.sqrt(jnp.linalg.det(arcs.T @ arcs)), jnp.abs(jnp.linalg.det(angles))

    arcs, angles = jax.jit(jax.vmap(determinants))(random_poses(key, 200)[:, :4])

    np.testing.assert_allclose(8 * arcs, 1.0, atol=1e-6)
    np.testing.assert_allclose(angles, 1.0, atol=1e-4)  # taken a step of 1e-6 off, where log is smooth


def test_contact_chart_inverts_for_all_faces(key: jax.Array) -> None:
    """A pose to its contact and back, over all 36 pairs of faces."""
    parents, children = jnp.split(random_poses(key, 72), 2)
    extents = jnp.array([0.1, 0.2, 0.3])
    faces = jnp.arange(36)

    def there_and_back(parent: jax.Array, child: jax.Array, pair: jax.Array) -> jax.Array:
        boxes = (extents, 2 * extents, pair // 6, pair % 6)
        return pose_from_contact(contact_from_poses(parent, child, *boxes), parent, *boxes)

    back = jax.jit(jax.vmap(there_and_back))(parents, children, faces)

    error = jax.jit(jax.vmap(lambda a, b: (jaxlie.SE3(a).inverse() @ jaxlie.SE3(b)).log()))(children, back)
    np.testing.assert_allclose(error, 0.0, atol=1e-9)


def test_flush_contact_stands_on_the_face() -> None:
    """A box on a table's top: its bottom touches, eta is the pole, (a, b) is where it stands."""
    table, box = jnp.array([0.5, 0.4, 0.01]), jnp.array([0.03, 0.05, 0.1])
    standing = Contact(jnp.array([0.2, -0.1, 0.0]), jnp.array([0.0, 0, 1]), jnp.array(0.7))
    bottom = jnp.array(4)

    pose = pose_from_contact(
        standing, jnp.array([1.0, 0, 0, 0, 0, 0, 0]), table, box, jnp.array(contact.TOP_FACE), bottom
    )

    np.testing.assert_allclose(pose[4:], [0.2, -0.1, 0.11], atol=1e-12)
    up = jaxlie.SO3(pose[:4]).apply(jnp.array([0.0, 0, 1]))
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-12)


@pytest.mark.parametrize("face", range(6))
def test_face_frames_point_outward(face: int) -> None:
    """The frame is right-handed, its third axis the outward normal, its first two the face's own."""
    frame = jaxlie.SO3(jnp.asarray(contact._FACE_WXYZ)[face]).as_matrix()
    normal = np.zeros(3)
    normal[contact.FACE_AXES[face]] = contact.FACE_SIGNS[face]

    np.testing.assert_allclose(frame[:, 2], normal, atol=1e-12)
    np.testing.assert_allclose(jnp.linalg.det(frame), 1.0)
    assert np.argmax(np.abs(frame[:, :2]), axis=0).tolist() == contact.FACE_SPANS[face].tolist()


def test_relative_box_agrees_with_the_chart(key: jax.Array) -> None:
    """What densities need of a contact is what the chart says."""
    parents, children = jnp.split(random_poses(key, 72), 2)
    extents = jnp.array([0.6, 0.5, 0.4])

    def both(parent: jax.Array, child: jax.Array, pair: jax.Array) -> tuple[Contact, tuple]:
        boxes = (extents, 0.5 * extents, pair // 6, pair % 6)
        chart = contact_from_poses(parent, child, *boxes)
        return chart, face_contact(relative_box(parent, child), *boxes)

    chart, (on_face, gap_m, eta_z) = jax.jit(jax.vmap(both))(parents, children, jnp.arange(36))

    half_sizes = np.asarray(extents)[contact.FACE_SPANS[np.arange(36) // 6]]
    expected = (np.abs(chart.offset_m[:, :2]) <= half_sizes).all(axis=1)
    assert 5 < expected.sum() < 31
    assert on_face.tolist() == expected.tolist()
    np.testing.assert_allclose(gap_m, chart.offset_m[:, 2], atol=1e-12)
    np.testing.assert_allclose(eta_z, chart.eta[:, 2], atol=1e-12)
