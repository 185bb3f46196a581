"""A hundred inputs that are nothing: ten kinds of files, each spoilt in ten ways. Each is refused by
the verb that reads its kind in one line, with status 2, in 4 GiB and a minute, and nothing is
written.
"""

from __future__ import annotations

import os
import resource
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from small_instrument import Run

from tofclip import Camera, Frames, PointCloud, load, point_cloud
from tofclip.shots import Returns

MAX_BYTES, MAX_SECONDS = 4 << 30, 60

# Each kind: a sound file of it, and the verb that reads it.
KINDS: dict[str, tuple[str, ...]] = {
    "streak.tif": ("convert", "--bin-width-ps", "20"),
    "streak.h5": ("convert",),
    "camera.h5": ("info",),
    "cube.npy": ("lidar", "photons", "--bin-width-ps", "80"),
    "cube.npz": ("lidar", "photons", "--bin-width-ps", "80"),
    "cube.mat": ("lidar", "photons", "--bin-width-ps", "80"),
    "cloud.ply": ("info",),
    "cloud.pcd": ("info",),
    "frames.h5": ("cloud",),
    "capture.h5": ("nlos", "reconstruct"),
}


def noise(size: int) -> bytes:
    return np.random.default_rng(size).bytes(size)


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda content: b"",
    "one byte": lambda content: content[:1],
    "the signature alone": lambda content: content[:8],
    "a tenth": lambda content: content[: len(content) // 10],
    "half": lambda content: content[: len(content) // 2],
    "noise": lambda content: noise(len(content)),
    "noise behind the signature": lambda content: content[:8] + noise(len(content)),
    "zeros behind the signature": lambda content: content[:8] + bytes(len(content)),
    "a letter": lambda content: b"Dear friend,\n" * 99,
    "a pipe": lambda content: b"",
}


@pytest.fixture(scope="module")
def sound(files: Path, confocal: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a sound file of every kind."""
    folder = tmp_path_factory.mktemp("sound")
    for name in ("streak.tif", "streak.h5", "camera.h5"):
        (folder / name).write_bytes((files / name).read_bytes())
    (folder / "capture.h5").write_bytes(confocal.read_bytes())
    cube = np.random.default_rng(0).poisson(0.1, (8, 9, 32)).astype(np.uint8)
    np.save(folder / "cube.npy", cube)
    np.savez(folder / "cube.npz", cube=cube)
    scipy.io.savemat(folder / "cube.mat", {"cube": cube})
    camera: Camera = load(files / "camera.h5")
    times = np.arange(20) * 20e-12 + 5e-9
    values = np.ones((20, *camera.image_shape), np.float32)
    Frames(values, times, camera).save(folder / "frames.h5")
    pixels = np.arange(30, dtype=np.int32)
    ones = np.ones(30, np.float32)
    returns = Returns(
        pixels, pixels, 2.0 * ones, ones, ones, ones.astype(np.uint8), 1e-8 * ones, camera
    )
    cloud: PointCloud = point_cloud(returns)
    cloud.save(folder / "cloud.ply")
    cloud.save(folder / "cloud.pcd")
    return folder


@pytest.fixture
def bounded() -> Iterator[None]:
    """Give this process 4 GiB more, and a minute."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + MAX_BYTES, before[1]))
    signal.alarm(MAX_SECONDS)
    yield
    signal.alarm(0)
    resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.mark.usefixtures("bounded")
@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("kind", KINDS)
def test_it_is_refused(run: Run, sound: Path, tmp_path: Path, kind: str, damage: str) -> None:
    bad = tmp_path / kind
    if damage == "a pipe":
        os.mkfifo(bad)
    else:
        bad.write_bytes(DAMAGES[damage]((sound / kind).read_bytes()))
    words = [*KINDS[kind], bad]
    if words[0] != "info":
        words += ["--out", tmp_path / ("out.npz" if words[0] == "lidar" else "out.h5")]
    outcome = run(*words)
    assert (outcome.status, outcome.out, outcome.err.count("\n")) == (2, "", 1), outcome
    assert outcome.err.startswith("tofclip: error: ")
    assert list(tmp_path.iterdir()) == [bad]
