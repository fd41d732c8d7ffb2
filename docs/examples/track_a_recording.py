"""Where the camera was, and how far that is from the poses that the recording brings.

python track_a_recording.py kitchen.mcap
"""

import sys

import numpy as np
import voxscene


def main(path: str, particles: int = 64) -> None:
    """Track a recording and print what came of it."""
    recording = voxscene.open_recording(path)
    trajectory = voxscene.track(recording, particles=particles)
    length_m = np.linalg.norm(np.diff(trajectory.mean[:, :3, 3], axis=0), axis=1).sum()
    print(f"{len(trajectory)} frames over {length_m:.2f} m, {int(trajectory.lost.sum())} lost")
    truth = voxscene.recorded_trajectory(path)
    if truth is not None and len(truth) == len(trajectory):
        poses = np.linalg.inv(truth.reference_from_camera[0]) @ truth.reference_from_camera
        apart_m = np.linalg.norm(poses[:, :3, 3] - trajectory.mean[:, :3, 3], axis=1)
        print(f"at most {100 * apart_m.max():.2f} cm from the recorded poses")


if __name__ == "__main__":
    main(sys.argv[1])
