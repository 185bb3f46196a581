"""The studies by name."""

from __future__ import annotations

from apps.studies import (
    coded_line,
    diffuser,
    iteration_costs,
    light_field_properties,
    light_field_recovery,
    occlusion,
    refocused_pictures,
    representation,
    surfaces,
)
from apps.studies.outcome import Study
from tofclip.errors import InputError

STUDIES: tuple[Study, ...] = (
    iteration_costs.STUDY,
    refocused_pictures.FLIP_STUDY,
    *light_field_recovery.STUDIES,
    *refocused_pictures.CORRUPTION_STUDIES,
    *occlusion.STUDIES,
    *representation.STUDIES,
    *diffuser.STUDIES,
    coded_line.STUDY,
    light_field_properties.GLOSSY_STUDY,
    light_field_properties.FOCUS_STUDY,
    refocused_pictures.ASSIGNMENT_STUDY,
    *surfaces.STUDIES,
)


def find_studies(name: str) -> tuple[Study, ...]:
    """Return the study of a name, of a figure that shows its pictures, or every one for ``all``."""
    found = tuple(study for study in STUDIES if name in ("all", study.name, *study.aliases))
    if not found:
        known = ", ".join(word for study in STUDIES for word in (study.name, *study.aliases))
        raise InputError(f"unknown study '{name}'; take all or one of {known}")
    return found
