"""`tofclip lidar`: how well ranges can be known, how views move with range, a scene's objects,
clouds of many shots, and these as one recording for other programs.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from apps.cli import make_group
from apps.options import (
    BIN_WIDTH,
    CAMERA,
    CLUSTER,
    FOCUS,
    FRAME_ID,
    PICTURE_FORMATS,
    SUFFIX,
    TIME_ZERO,
    TOPIC,
    arg,
    flag,
    opt,
)
from apps.progress import report_summary, run_with_progress, show_activity, show_progress
from apps.report import (
    PRINTS_JSON,
    RECORD_SUFFIXES,
    describe_ranges,
    make_folder,
    report,
    require_writable,
)
from apps.verbs.photons import photons
from apps.verbs.recover import CLOUD_SUFFIXES, require_format
from tofclip.errors import InputError
from tofclip.files import PICTURE_SUFFIXES

if TYPE_CHECKING:
    from tofclip.lidar.ros import StampedCloud

app = make_group(
    "How well a range can be known, and how the views' parallax grows with it; many shots in a row."
)
app.command()(photons)


@app.command()
def bag(
    clouds: Path = arg(
        "CLOUDS",
        "Point clouds: a file, a folder or a quoted pattern; or a bag or MCAP file with them.",
        read=True,
    ),
    out: Path = opt(
        "BAG",
        "Ends in .mcap for one MCAP file; any other name is a new folder, a ROS 2 bag; or where a bag's clouds go.",
        ...,
    ),
    topic: str | None = TOPIC,
    frame_id: str = FRAME_ID,
    suffix: str = SUFFIX,
    rate_hz: float = opt("HZ", "Clouds a second, in the order of their names.", 10.0),
    start_s: float = opt("S", "Stamp of the first cloud, since the epoch.", 0.0),
) -> None:
    """Write clouds with stamps as ROS 2 messages (sensor_msgs/PointCloud2 in an optical frame), or the
    clouds of such a recording, whichever program made it, as files.

    Stamps of an instrument are written by stream --out run.mcap. Needs no ROS, but rosbags:
    pip install 'tofclip[exchange]'.

    Example: tofclip lidar bag clouds/ --out drive.mcap --rate-hz 25
    """
    from tofclip.lidar import PointCloud, ros
    from tofclip.lidar.ros import MCAP_SUFFIX, NANOSECONDS_PER_SECOND, StampedCloud
    from tofclip.sequences import list_files
    from tofclip.sequences.ranger import build_cloud_path
    from tofclip.sequences.recovering import PLAN_NAME

    if not (rate_hz > 0 and start_s >= 0):
        raise InputError("the rate must be positive and the start not negative")
    if ros.is_bag(clouds):
        require_format(suffix)
        points, stamps = 0, []
        for number, one in enumerate(ros.read_bag(clouds, topic)):
            if not number:
                make_folder(out)
            one.cloud.save(build_cloud_path(out, number, suffix))
            points += len(one.cloud)
            stamps.append(one.stamp_ns)
        seconds = (stamps[-1] - stamps[0]) / NANOSECONDS_PER_SECOND if stamps else 0.0
        report({"clouds": len(stamps), "points": points, "seconds": seconds}, [out])
        return
    files = [
        file
        for file in ([clouds] if clouds.is_file() else list_files(clouds).values())
        if file.suffix.lower() in CLOUD_SUFFIXES and file.name != PLAN_NAME
    ]
    if not files:
        raise InputError(f"{clouds}: there is no cloud; names end in {', '.join(CLOUD_SUFFIXES)}")
    if out.suffix.lower() == MCAP_SUFFIX:
        require_writable(out, inputs=files)
    points = 0

    def read() -> Iterator[StampedCloud]:
        nonlocal points
        for number, file in enumerate(files):
            cloud = PointCloud.load(file)
            points += len(cloud)
            yield StampedCloud(cloud, round((start_s + number / rate_hz) * NANOSECONDS_PER_SECOND))
            advance(1)

    with show_progress("writing", len(files)) as advance:
        number = ros.write_bag(read(), out, topic or ros.TOPIC, frame_id)
    figures = {"clouds": number, "points": points, "seconds": (number - 1) / rate_hz}
    report(figures, [out])


@app.command()
def accuracy(
    photons: float = opt("N", "Expected photons of a return.", 100.0),
    background: float = opt("N", "Expected background photons in a bin.", 0.1),
    width: float = opt("PS", "Full width at half maximum of the pulse.", 60.0, name="--pulse-ps"),
    decay: float | None = opt(
        "PS",
        "Time constant of the pulse's tail.",
        name="--decay-ps",
        shown="a Gaussian, no tail",
    ),
    bin_width: float = opt("PS", "Duration of a bin.", 20.0, name="--bin-width-ps"),
    bins: int = opt("N", "Bins of a histogram.", 256),
    false_alarm_rate: float = opt(
        "SHARE", "Histograms without a return in which one may be announced.", 0.01
    ),
    trials: int = opt("N", "Histograms with a return, and as many without.", 2000),
    seed: int = opt("N", "Of the photons' chance.", 0),
) -> None:
    """Locate returns in simulated photon histograms and compare the error with the Cramer-Rao
    bound.

    Example: tofclip lidar accuracy --photons 100 --background 0.1 --pulse-ps 60 --bin-width-ps 20
    --trials 200
    """
    from dataclasses import asdict

    from tofclip.lidar import Pulse
    from tofclip.lidar.photons import PhotonDetector, measure_accuracy

    pulse = Pulse.gaussian(width) if decay is None else Pulse.exponentially_modified(width, decay)
    detector = PhotonDetector(pulse, bin_width, bins, false_alarm_rate)
    with show_progress("simulating", max(trials, 1)) as advance:
        found = measure_accuracy(detector, photons, background, trials, seed, advance)
    report(asdict(found))


@app.command()
def parallax(
    streak: Path = arg("STREAK", "A shot of a scene at several ranges.", read=True),
    out: Path = opt("H5", "The camera to write, for recover --focus depth-locked.", ...),
    camera: Path | None = CAMERA,
    time_zero: float | None = TIME_ZERO,
    gates: int = opt("N", "Time gates, of equal brightness.", 8),
    shears: tuple[float, float, int] = opt(
        "S0 S1 N", "Shears tried, pixels per view step.", (-3.0, 3.0, 13)
    ),
) -> None:
    """Find lenslet pitch and focus distance from a shot: at which shear the views agree, gate by
    gate.

    Example: tofclip lidar parallax shot.tif --camera camera.h5 --out camera_locked.h5
    """
    require_writable(out, *RECORD_SUFFIXES, inputs=(streak, camera))
    with show_activity(f"reading {streak}"):
        from tofclip.recovery import count_parallax_work, fit_parallax_to_shot, open_shot

        shot = open_shot(streak, camera, time_zero)
    if time_zero is None and not shot.camera.time_zero:
        raise InputError(
            "shears follow from true ranges, and no time zero is known: give --time-zero-ns"
        )
    with show_progress("focusing", count_parallax_work(shot, shears)) as advance:
        found = fit_parallax_to_shot(shot, gates, shears, advance)
    found.camera.save(out)
    figures = {
        "strength_px_m": found.parallax.strength,
        "lenslet_pitch_m": found.camera.lenslet_pitch,
        "focus_distance_m": found.camera.focus_distance,
        "misfit_px": found.parallax.misfit_px,
        "range_m": found.distances,
        "shear_px": found.curve.shears,
        "weight": found.curve.weight,
    }
    report(figures, [out])


@app.command()
def scene(
    frames: Path = arg("FRAMES", "Recovered frames (HDF5).", read=True),
    out: Path = opt("PNG", f"The picture to write: {PICTURE_FORMATS}.", ...),
    reach: float = opt("MM", "Points this close belong together.", 40.0, name="--reach-mm"),
    fewest_points: int = opt("N", "Smaller groups are not objects.", 40),
) -> None:
    """List a scene's objects with range, size and standard deviation; draw them from three sides.

    Points fainter than a twentieth of the brightest are left out: most are rays that few views leave
    around bright things. `cloud` has them all.

    Example: tofclip lidar scene frames.h5 --out scene.png
    """
    import numpy as np

    from apps.figures.shot import make_scene_figure
    from tofclip.lidar import Detection, depth, point_cloud
    from tofclip.lidar.cloud import find_objects
    from tofclip.lidar.significance import SCENE_BRIGHTNESS_QUANTILE
    from tofclip.notebook import save_figure
    from tofclip.shots import Frames

    require_writable(out, *PICTURE_SUFFIXES, inputs=(frames,))
    with show_activity("finding objects"):
        recovered = Frames.load(frames)
        cloud = point_cloud(depth(recovered))
        if len(cloud):
            brightest = np.quantile(cloud.intensity, SCENE_BRIGHTNESS_QUANTILE)
            cloud = cloud[cloud.intensity >= Detection().min_scene_fraction * brightest]
        objects = find_objects(cloud, reach, fewest_points)
    # Before the picture, which would show an empty scene.
    if not objects:
        raise InputError(
            f"{frames}: no {fewest_points} points lie together within {1000 * reach:g} mm"
        )
    with show_activity("drawing"):
        save_figure(make_scene_figure(recovered, cloud, objects), out)
    named = ("range", "width", "height", "range_sigma", "scatter")
    rows = [
        {f"{name}_m": getattr(one, name) for name in named} | {"points": one.points.size}
        for one in objects
    ]
    if PRINTS_JSON.get():  # the deviation's earlier name: for one more version
        rows = [row | {"confidence_m": row["range_sigma_m"]} for row in rows]
    report({"points": len(cloud), "objects": rows}, [out], describe_ranges(recovered))


@app.command()
def sequence(
    shots: Path = arg(
        "SHOTS",
        "A folder or quoted pattern of streak images, or an HDF5 stack of them.",
        read=True,
    ),
    out: Path = opt("FOLDER", "Where the clouds go; those already there are kept.", ...),
    camera: Path | None = CAMERA,
    bin_width: float | None = BIN_WIDTH,
    time_zero: float | None = TIME_ZERO,
    average: int = opt("N", "Shots averaged for each cloud, as far as nothing changes.", 1),
    focus: str = FOCUS,
    suffix: str = SUFFIX,
    keep_jitter: bool = flag(
        "--keep-jitter", "Do not find how late each shot comes against the first."
    ),
    cluster: str | None = CLUSTER,
) -> None:
    """Make a cloud of each shot by the linear inverse, one shot in memory at a time.

    Started again after an interruption, it makes the clouds that are missing in the folder. Shots
    that fail are listed at the end, and the exit status is 1.

    Example: tofclip lidar sequence shots/ --camera camera.h5 --out clouds/
    """
    from tofclip.files import require_apart
    from tofclip.sequences import RangingSettings, list_shots

    # Before the jobs claim the folder.
    require_format(suffix)
    require_apart([out], [shots, camera])
    settings = RangingSettings(camera, time_zero, focus, average, not keep_jitter)
    jobs = settings.jobs(list_shots(shots, bin_width), out, suffix)
    made: list[tuple[int, list[float]]] = []
    # Without figures come clouds that were there already, whose points are not counted again.
    summary = run_with_progress(
        *("ranging", jobs, cluster),
        lambda one: None if one.figures is None else made.append(one.figures),
    )
    late = [bins for _, shifts in made for bins in shifts]
    figures = {
        "shots": len(late),
        "shots_per_second": len(late) / summary.seconds,
        "points": sum(points for points, _ in made),
        # Root mean square; 0 where nothing was done, and of one shot but for rounding.
        "jitter_rms_bins": round((sum(one**2 for one in late) / max(len(late), 1)) ** 0.5, 6),
    }
    report_summary(summary, len(jobs), out, figures)
