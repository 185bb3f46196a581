"""Every case, by name: those of the benchmark page, and the studies, which are run by name only."""

from __future__ import annotations

import importlib

from apps.benchmarks import instruments, lensless, light_fields, nlos, ranging, recovery
from apps.benchmarks.harness import Case
from tofclip.errors import InputError

CASES: tuple[Case, ...] = (
    *recovery.CASES,
    *light_fields.CASES,
    *lensless.CASES,
    *ranging.CASES,
    *nlos.CASES,
    *instruments.CASES,
)
"""The page's cases: all of them take some ten minutes."""

STUDIES = {
    "camera": "light_field_cameras",
    "quality": "picture_quality",
    "accuracy": "range_accuracy",
    "device": "array_devices",
    "corner": "nlos_studies",
    "sequence": "sequences",
    "driver": "drivers",
    "viewer": "viewer",
}
"""Groups that need an extra program, recorded data, another device or much time, and their modules."""


def find_cases(name: str) -> tuple[Case, ...]:
    """Return the case of a name, those of a group, or the page's for ``all``."""
    group = name.partition("-")[0]
    cases = load_study(group) if group in STUDIES else CASES
    found = tuple(case for case in cases if name in ("all", case.name, case.group))
    if not found:
        groups = ", ".join([*dict.fromkeys(case.group for case in CASES), *STUDIES])
        raise InputError(
            f"unknown benchmark '{name}'; take all, a group ({groups}) or one of a group, as recovery-l1"
        )
    return found


def load_study(group: str) -> tuple[Case, ...]:
    """Return the cases of a study."""
    try:
        module = importlib.import_module(f"apps.benchmarks.{STUDIES[group]}")
    except ImportError as absence:
        raise InputError(
            f"the study '{group}' needs {absence.name}: pip install {absence.name}"
        ) from absence
    cases: tuple[Case, ...] = module.CASES
    return cases
