"""Jobs that a test can ask for: well-behaved, failing, deadly. Workers import this module by its
name.
"""

import os
import resource
import signal
from functools import partial

from tofclip.errors import InputError
from tofclip.files import atomic_path
from tofclip.sequences.jobs import Job


def square(number, result):
    """Write a square."""
    with atomic_path(result) as temporary:
        temporary.write_text(str(number**2))
    return number**2


def refuse(result):
    raise InputError(f"{result.name}: is not to be had\nat any price")


def stumble():
    raise ZeroDivisionError("a defect")


def die(result, *, every_time):
    """Kill the worker in the middle of writing; with `every_time` also the next one."""
    once = result.with_suffix(".died")
    if every_time or not once.exists():
        once.touch()
        with atomic_path(result) as temporary:
            temporary.write_text("half a resu")
            os.kill(os.getpid(), signal.SIGKILL)
    square(7, result)


def on_a_full_disk(work):
    """Do a job while no file may grow beyond a kilobyte: the system refuses to write on, as a full
    disk does.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1024, hard))
    try:
        return work()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def squares(folder, count):
    paths = [folder / f"{number:03d}.txt" for number in range(count)]
    return [
        Job(path.stem, path, partial(square, number, path)) for number, path in enumerate(paths)
    ]
