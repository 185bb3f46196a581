"""Every case, by name."""

from __future__ import annotations

from apps.benchmarks import clip, instruments, lidar, recovery
from apps.benchmarks import nlos as corner
from apps.benchmarks.case import Case
from tofclip.errors import InputError

CASES: tuple[Case, ...] = (
    *recovery.CASES,
    *clip.CASES,
    *lidar.CASES,
    *corner.CASES,
    *instruments.CASES,
)


def find_cases(name: str) -> tuple[Case, ...]:
    """Return the case of a name, those of a group, or every one for ``all``.

    Raises
    ------
    InputError
        Nothing has that name.
    """
    found = tuple(case for case in CASES if name in ("all", case.name, case.group))
    if not found:
        groups = ", ".join(dict.fromkeys(case.group for case in CASES))
        raise InputError(
            f"unknown benchmark '{name}'; take all, a group ({groups}) or one of a group, as recovery-l1"
        )
    return found
