"""`tofclip recover` and `tofclip cloud`: a streak image to one picture per instant, and these to a
point cloud; one of them, or a sequence, here or on a cluster. `tofclip stream`: shots to clouds while
they come, with every stage's latency.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from apps.options import (
    BIN_WIDTH,
    CAMERA,
    CLUSTER,
    DEVICE,
    FOCUS,
    FRAME_ID,
    PREVIEW,
    STREAK_IMAGE,
    SUFFIX,
    TIME_ZERO,
    TOPIC,
    arg,
    flag,
    name_any,
    opt,
)
from apps.progress import (
    EXIT_SOME_FAILED,
    report_summary,
    resolve_device,
    run_with_progress,
    show_activity,
    show_progress,
)
from apps.report import (
    choose_preview,
    describe_ranges,
    make_folder,
    name_options,
    report,
    require_new,
    require_writable,
    say,
    with_past,
)
from tofclip.errors import InputError, TofclipError, require_known
from tofclip.files import require_apart
from tofclip.plugins import DENOISERS, METHODS, split_assignments

if TYPE_CHECKING:
    from devices.transients import ShotStamp, TrackedShots
    from tofclip.lidar import PointCloud
    from tofclip.sequences.streaming import LiveShot, StreamedCloud

CLOUD_SUFFIXES = (".ply", ".pcd", ".csv", ".npz", ".las", ".laz", ".e57", ".h5")
DEPTH_SUFFIX = ".exr"
ALL_POINTS = flag(
    "--all-points",
    "Drop no point of the cloud: false_alarm says how probably each one is false.",
)


def recover(
    streak: str = arg(
        "STREAK",
        f"{STREAK_IMAGE}, or a source such as sim+linospad2://?seed=1. "
        "A sequence: a folder, a quoted pattern, or an HDF5 stack.",
        read=True,
    ),
    out: Path = opt("H5", "The frames to write; of a sequence: their folder.", ...),
    camera: Path | None = CAMERA,
    bin_width: float | None = BIN_WIDTH,
    time_zero: float | None = TIME_ZERO,
    method: str = opt(
        "NAME",
        f"{', '.join(METHODS.own)}, or another of tofclip plugins. surfaces: range and brightness of each pixel from "
        "the whole shot; auto: these, or tv where the shot is not of surfaces or iterations, weight or focus are "
        "given; pnp, red: a denoiser plugged in.",
        "auto",
        choices=METHODS,
    ),
    iterations: int | None = opt(
        "N", "Maximum number, of methods that have iterations.", shown="the method's"
    ),
    weight: float | None = opt(
        "SHARE",
        "Of the prior: how much it counts, of what would leave nothing (surfaces: in deviations of the noise).",
        shown="the method's",
    ),
    denoiser: str | None = opt(
        "NAME",
        f"For pnp and red: {', '.join(DENOISERS.own)}, or another of tofclip plugins.",
        shown="collaborative",
        choices=DENOISERS,
    ),
    settings: list[str] | None = opt(
        "NAME=VALUE",
        "One of the method's or the denoiser's own settings, which tofclip plugins NAME lists; may be given again.",
        name="--set",
        shown="theirs",
    ),
    focus: str = opt(
        "SHEAR",
        "depth-locked: each frame at the shear of its range; fixed:S: all at S pixels per view step; "
        "stack:S0:S1:N: each gate at the best of N.",
        "fixed:0",
    ),
    cloud: Path | None = opt("PLY", "A point cloud to write as well.", shown="none"),
    all_points: bool = ALL_POINTS,
    preview: Path | None = PREVIEW,
    sweep: list[str] | None = opt(
        "NAME=V,V",
        "Of a sequence: every combination of these values of method, iterations, weight or focus, each in a folder of "
        "its own; may be given again.",
        shown="none",
    ),
    cluster: str | None = CLUSTER,
    device: str = DEVICE,
) -> None:
    """Recover every transient frame of a raw streak image, or of each one of a sequence.

    Where the camera's sweep is not known, skew, gains and centres are found from the shot itself.
    Readings of the sensor that are hot, dead or struck by a particle are left out, and those cut
    off at its limit may be brighter in the frames; both are counted.

    Of a sequence, what is in the folder already is kept: started again, a run goes on where it
    stopped. Shots that cannot be recovered are listed at the end, and the exit status is 1.

    Example: tofclip recover shot.tif --camera camera.h5 --out frames.h5 --time-zero-ns -10.784
    """
    with show_activity("starting"):  # a second or more of imports
        from tofclip.recovery import (
            compute_view_delays_bins,
            make_method,
            open_shot,
            parse_focus,
            plan_recovery,
        )
        from tofclip.sequences import (
            CloudSettings,
            RecoverySettings,
            expand_sweep,
            is_sequence,
            list_shots,
        )

    own = {"denoiser": denoiser} if denoiser else {}
    own |= split_assignments(settings or ())
    if is_sequence(streak):
        # Options without effect are refused rather than ignored.
        if cloud is not None:
            raise InputError("--cloud is for one shot; give the folder of frames to tofclip cloud")
        if preview is not None:
            raise InputError("--preview is for one shot")
        recovery = RecoverySettings(
            method, iterations, weight, focus, camera, time_zero, device, own
        )
        used = resolve_device(device, cluster)
        require_apart([out], [streak, camera])
        shots = list_shots(streak, bin_width)
        tried = (text.partition("=") for text in sweep or [])
        swept = expand_sweep(recovery, {name: values.split(",") for name, _, values in tried})
        jobs = [job for label, one in swept.items() for job in one.jobs(shots, out / label)]
        summary = run_with_progress("recovering", jobs, cluster)
        report_summary(summary, len(jobs), out, {"device": used})
        return
    if cluster is not None or sweep:
        option = "--sweep" if cluster is None else "--cluster"
        raise InputError(
            f"{streak}: {option} is for a sequence: a folder, a quoted pattern or an HDF5 stack of shots"
        )
    if all_points and cloud is None:
        raise InputError("--all-points is for the points of --cloud")
    preview = choose_preview(out, preview, (streak, camera))
    if cloud is not None:
        require_writable(cloud, *CLOUD_SUFFIXES, inputs=(streak, camera))
    solver = make_method(method, **{"iterations": iterations, "weight": weight, **own})
    chosen_focus = parse_focus(focus)
    started = time.perf_counter()
    with show_activity(f"reading {streak}"):
        # Outputs and settings have been checked by now: an instrument is not started for nothing.
        from devices.transients import find_address, read_transient
        from tofclip.shots import Streak

        address = streak if "://" in streak else find_address(streak)
        if address is not None:
            taken = read_transient(address, bin_width)
            if not isinstance(taken, Streak):
                raise InputError(
                    f"{streak}: its pixels look at the scene themselves, so that nothing is to be recovered; "
                    "tofclip stream and tofclip lidar photons make clouds"
                )
            shot = open_shot(taken, camera, time_zero)
        else:
            shot = open_shot(streak, camera, time_zero, bin_width)
        plan = plan_recovery(shot, solver, chosen_focus, device)
    # An instrument's address is no file with a checksum.
    inputs = [Path(one) for one in (streak, camera) if one is not None and "://" not in str(one)]
    memory = f"about {plan.memory_bytes / 1e9:.1f} GB of memory"
    with show_progress(f"recovering, {memory}", plan.work) as advance:
        frames = plan.add_provenance(plan.run(advance), *inputs)
    with show_activity("writing"):
        from apps.figures.shot import make_preview_figure
        from tofclip.notebook import save_figure

        frames.save(out)
        seconds = time.perf_counter() - started
        save_figure(make_preview_figure(shot.streak, frames), preview)
        if cloud is not None:
            clouds = CloudSettings(device=device, false_alarm=1.0 if all_points else None)
            points, _ = clouds.make_cloud(frames, "the recovered frames")
            points.save(cloud)
    known = frames.figures
    names = ("method", "iterations", "relative_residual", "seconds", "frames_per_second")
    # methods that know how far they are from the best there is say so, and shots that are not clean
    further = (
        "why_no_surfaces",
        "unexplained_light",
        "duality_gap",
        "defective_readings",
        "clipped_readings",
    )
    figures = {
        "frames": frames.values.shape[0],
        "image_shape": frames.camera.image_shape,
        **{name: known[name] for name in names},
        "frames_per_second_overall": frames.values.shape[0] / seconds,
        "view_gains": frames.camera.gains,
        "time_shift_bins": compute_view_delays_bins(frames.camera),
        "stopped_because": known["stopped_because"],
        "device": known["device"],
        **{name: known[name] for name in further if name in known},
    }
    written = [out, preview, *([cloud] if cloud else [])]
    report(figures, written, json_only=("seconds", "frames_per_second"))


def cloud(
    frames: Path = arg(
        "FRAMES",
        "Recovered frames (HDF5). A sequence: a folder or a quoted pattern of them.",
        read=True,
    ),
    out: Path = opt(
        "FILE",
        f"Ends in {name_any(CLOUD_SUFFIXES)}, or {DEPTH_SUFFIX} for a depth picture; of a sequence: a folder.",
        ...,
    ),
    drop_outliers: bool = flag(
        "--drop-outliers", "Leave out points further from their neighbours than these are."
    ),
    returns: str = opt("WHICH", "Of each pixel: first, strongest, last or all.", "all"),
    organised: bool = flag(
        "--organised",
        "A point for every pixel, row by row, NaN where nothing came back (.pcd, .ply, .npz, .csv); of a "
        "pixel's returns the strongest, unless --returns says which.",
    ),
    false_alarm: float | None = opt(
        "P", "Drop points that are false with a higher probability.", shown="0.1"
    ),
    all_points: bool = ALL_POINTS,
    voxel: float | None = opt(
        "MM", "One point for each cube of this side.", name="--voxel-mm", shown="all points"
    ),
    suffix: str = opt(".EXT", "Format of the clouds of a sequence.", ".ply"),
    cluster: str | None = CLUSTER,
    device: str = DEVICE,
) -> None:
    """Find each pixel's returns and place them in space: x right, y down, z forward, in metres.

    Columns of a point: intensity, range with its standard deviation (range_sigma), number within the
    pixel, time of flight; where known the probability that it is false (false_alarm) and the
    surface's reflectance in percent (see calibrate range).

    Of a sequence, clouds that are in the folder already are kept; inputs that fail
    are listed at the end, and the exit status is 1.

    Example: tofclip cloud frames.h5 --out scene.ply

    Example: tofclip cloud frames.h5 --out scene.pcd --returns first --organised

    Example: tofclip cloud 'frames/*.h5' --out clouds/ --cluster local
    """
    from tofclip.lidar.cloud import ORGANISED_SUFFIXES
    from tofclip.sequences import CloudSettings, is_sequence, list_files
    from tofclip.sequences.recovering import save_cloud
    from tofclip.shots import Frames

    if organised and returns == "all":
        returns = "strongest"  # a pixel has one place in an organised cloud
    if all_points and false_alarm is not None:
        raise InputError("--all-points drops no point, so that --false-alarm has no effect")
    false_alarm = 1.0 if all_points else false_alarm
    settings = CloudSettings(drop_outliers, voxel, device, returns, organised, false_alarm)
    used = resolve_device(device, cluster)
    if is_sequence(frames):
        require_format(suffix, DEPTH_SUFFIX)
        require_apart([out], [frames])
        jobs, counts = settings.jobs(list_files(frames), out, suffix), list[int]()
        summary = run_with_progress(
            "placing", jobs, cluster, lambda one: counts.append(one.figures or 0)
        )
        report_summary(summary, len(jobs), out, {"points": sum(counts), "device": used})
        return
    # An option without effect is refused rather than ignored.
    if cluster is not None:
        raise InputError(
            f"{frames}: --cluster is for a sequence: a folder or a quoted pattern of frames"
        )
    suffixes = ORGANISED_SUFFIXES if organised else (*CLOUD_SUFFIXES, DEPTH_SUFFIX)
    require_writable(out, *suffixes, inputs=(frames,))
    with show_activity("finding returns"):
        recovered = Frames.load(frames)
        # The cloud carries the history of its frames, and so that of the shot.
        recovered = with_past(recovered, {"verb": "cloud"}, frames)
        points, kept = settings.make_cloud(recovered, str(frames))
        save_cloud(points, kept, out, organised)
    rows, columns = kept.camera.image_shape
    figures = {
        "points": len(points),
        "range_m": [points.range.min(), points.range.max()],
        "returns_per_pixel_mean": len(points) / (rows * columns),
        "device": used,
    }
    report(figures, [out], describe_ranges(recovered))


def require_format(suffix: str, *further: str) -> None:
    """Refuse an ending that names no format of clouds."""
    require_known("format of clouds", suffix, (*CLOUD_SUFFIXES, *further))


MAX_LATENCY_SAMPLES = 10_000  # over which medians are taken: a stream may run for days


def stream(
    source: str = arg(
        "SOURCE",
        "An instrument's address such as 'sim+remoteex://?seed=1', a folder of shots or an HDF5 stack.",
        read=True,
    ),
    out: Path | None = opt(
        "FOLDER",
        "Where the clouds go; a name that ends in .mcap is one file of ROS 2 messages with the instrument's stamps.",
        shown="nowhere",
    ),
    camera: Path | None = CAMERA,
    bin_width: float | None = BIN_WIDTH,
    time_zero: float | None = TIME_ZERO,
    focus: str = FOCUS,
    method: str | None = opt(
        "NAME",
        "Of streak images. l1 or tv: twelve iterations that begin at the last shot's pictures; linear, the "
        "fastest on small pictures, which draws rays around bright objects; or surfaces, the truest and "
        "slowest, which follow those of the last shot.",
        shown="l1",
    ),
    average: int = opt(
        "N", "Streak images averaged at most, as far as nothing changes; histograms always are.", 1
    ),
    shots: int | None = opt("N", "Stop after this number of clouds.", shown="at the source's end"),
    held: int = opt("N", "Shots that may wait for their turn.", 1),
    drop: bool = flag(
        "--drop",
        "Drop the oldest waiting shot where they come too fast, as always for an instrument.",
    ),
    suffix: str = SUFFIX,
    topic: str | None = TOPIC,
    frame_id: str = FRAME_ID,
) -> None:
    """Make a cloud of each shot while the next ones come; report method, rate and latencies.

    Photons become a shot in batches, pictures one by one: see records= and frames=
    of an address. Of an instrument the newest shot is taken. acquired = delivered + dropped_device
    + dropped_host + failed counts every shot that it took, and clouds bear its numbers. Shots of
    which no cloud can be made are listed as they come, and the exit status is 1. latency_median_s is
    the time from the instrument's own stamp until the cloud is there (latency_from says so;
    "arrival" where it sends no time), taking the shortest message delay as zero.

    Example: tofclip stream 'sim+remoteex://?seed=1' --shots 20 --out clouds/
    """
    from dataclasses import asdict
    from itertools import islice

    from devices.transients import TrackedShots
    from tofclip.lidar import ros
    from tofclip.recovery import parse_focus
    from tofclip.sequences import make_pipeline
    from tofclip.sequences.ranger import build_cloud_path
    from tofclip.sequences.streaming import stream_clouds

    require_format(suffix)
    if shots is not None and shots < 1:
        raise InputError(f"--shots must be positive, got {shots}")
    is_file = out is not None and out.suffix.lower() == ros.MCAP_SUFFIX
    if out is not None and is_file:
        require_writable(out, inputs=(source, camera))
    elif out is not None:
        existing = list(out.glob(f"cloud_*{suffix}"))
        require_apart([out, *existing], [source, camera])
        require_new(*existing)
    coming = TrackedShots(_read_shots(source, bin_width))
    # The first shot brings the camera and the time axis of all.
    first = coming.peek()
    if first is None:
        fault = next(coming, None)
        if isinstance(fault, TofclipError):
            raise fault
        raise InputError(f"{source}: the source ended before it gave a shot")
    pipeline = make_pipeline(first, camera, time_zero, parse_focus(focus), method, average)
    if out is not None and not is_file:  # only now: what cannot be streamed leaves no empty folder
        make_folder(out)
    failed = 0

    def note_failure(number: int, fault: TofclipError) -> None:
        nonlocal failed
        failed += 1
        say("failed", f"shot {number}: {name_options(str(fault))}")

    # Instruments do not wait: the newest shot counts. Files do, and lose nothing.
    made = stream_clouds(
        coming,
        pipeline,
        held,
        "drop_oldest" if drop or coming.is_live else "block",
        on_failure=note_failure,
    )
    tally = _Tally()
    with closing(made):
        taken = tally.watch(islice(made, shots), coming)
        if out is None:
            deque(taken, maxlen=0)
        elif is_file:
            stamped = (ros.StampedCloud(cloud, stamp.epoch_ns) for cloud, stamp in taken)
            ros.write_bag(stamped, out, topic or ros.TOPIC, frame_id)
        else:
            for cloud, stamp in taken:
                cloud.save(build_cloud_path(out, stamp.number, suffix))
    # Counted last: only when the instrument has been stopped are its accounts final.
    accounts = coming.count_shots(tally.clouds, failed)
    figures = tally.list_figures() | {
        "method": pipeline.method_name,
        "dropped": accounts.dropped,
        **asdict(accounts),
    }
    report(figures, [] if out is None else [out], json_only=["latency_s"])
    if failed:
        raise typer.Exit(EXIT_SOME_FAILED)


def _read_shots(
    source: str, bin_width: float | None
) -> Iterator[LiveShot] | Iterator[LiveShot | TofclipError]:
    """Shots of an instrument, a folder or a stack; errors in place of those that cannot be read."""
    from devices.transients import TransientStream, find_address
    from tofclip.sequences import list_shots

    address = source if "://" in source else Path(source).is_file() and find_address(source)
    if address:
        return TransientStream(address, bin_width)

    def read(shot: Callable[[], LiveShot]) -> LiveShot | TofclipError:
        try:
            return shot()
        except TofclipError as fault:
            return fault

    return map(read, list_shots(source, bin_width).values())


class _Tally:
    """What is reported of clouds as they come."""

    def __init__(self) -> None:
        self.clouds = self.points = 0
        self._times = {name: deque[float](maxlen=MAX_LATENCY_SAMPLES) for name in ("age", "all")}
        self._origin, self._seconds = "file", 0.0

    def watch(
        self, made: Iterable[StreamedCloud], shots: TrackedShots
    ) -> Iterator[tuple[PointCloud, ShotStamp]]:
        """Yield every cloud with its shot's stamp."""
        started = time.perf_counter()
        for one in made:
            stamp = shots.get_stamp(one.shot)
            age = stamp.compute_age()
            known = "instrument" if stamp.taken_at else "arrival" if stamp.received_at else ""
            self._origin = known or self._origin
            yield one.cloud, stamp
            self.clouds += 1
            self.points += len(one.cloud)
            seconds = {"age": one.latency if age is None else age, "all": one.latency}
            for name, value in (seconds | dict(one.seconds)).items():
                self._times.setdefault(name, deque(maxlen=MAX_LATENCY_SAMPLES)).append(value)
            self._seconds = time.perf_counter() - started

    def list_figures(self) -> dict[str, Any]:
        known = {name: compute_quantiles(seconds) for name, seconds in self._times.items()}
        ages, latency = known.pop("age"), known.pop("all")
        return {
            "clouds": self.clouds,
            **{f"latency_{name}_s": value for name, value in ages.items()},
            "latency_from": self._origin,
            "points": self.points,
            "clouds_per_second": self.clouds / self._seconds if self.clouds else 0.0,
            "latency_s": latency,
            "stages_s": known,
        }


def compute_quantiles(seconds: Iterable[float]) -> dict[str, float]:
    """Return median and 95th percentile by their names; nothing of nothing."""
    import numpy as np

    values = list(seconds)
    found = np.quantile(values, (0.5, 0.95)).tolist() if values else ()
    return dict(zip(("median", "p95"), found, strict=False))
