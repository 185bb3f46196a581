"""Through occluders that reflect (Table 7, Supp. Fig. 15), by time of flight instead of black
occluders.
"""

from __future__ import annotations

from apps.occlusion.experiment import DEFAULT_PHOTONS, Experiment, ExperimentSettings
from apps.occlusion.scenes import make_occlusion_scene
from apps.studies.cases import CAMERA_NAMES, run_in_parallel
from apps.studies.library import Library
from apps.studies.occlusion import PAPER_NMSE_PERCENT
from apps.studies.outcome import Advance, Outcome, Panel, Row, Study
from tofclip.metrics import nmse

SCENES = ("tree", "person", "bush", "plate")
"""As the paper's: a mannequin behind a tree and behind a plate, a word behind a bush and behind a
plate.
"""

RATIOS = (1.0, 0.5)


def run_flash_occlusion(library: Library, seeds: int, advance: Advance) -> Outcome:
    """Flash scenes behind occluders, gate, and recover with and without the model of what the
    occluder hides.

    Parameters
    ----------
    library : Library
        Light fields and recordings by name.
    seeds : int
        Repeats with other random numbers.
    advance : callable
        Called with the number of steps just done.

    Returns
    -------
    Outcome
        A row of figures for each case, and the pictures to show.
    """
    side = min(library.array.image_shape)
    cases = [
        (scene, encoder, ratio)
        for scene in SCENES
        for encoder in PAPER_NMSE_PERCENT
        for ratio in RATIOS
    ]

    def seen(case: tuple[str, str, float]) -> list[Experiment]:
        scene, encoder, ratio = case
        done = []
        for seed in range(seeds):
            settings = ExperimentSettings(
                side, encoder, ratio, photons=DEFAULT_PHOTONS[encoder], seed=seed
            )
            done.append(Experiment(make_occlusion_scene(scene), settings))
            _ = done[-1].separated
            advance(1)
        return done

    rows: list[Row] = []
    panels: dict[str, list[Panel]] = {scene: [] for scene in SCENES}
    for (scene, encoder, ratio), found in zip(cases, run_in_parallel(seen, cases), strict=True):
        paper = PAPER_NMSE_PERCENT[encoder][SCENES.index(scene)][RATIOS.index(ratio)]
        target, plain = (
            tuple(100 * nmse(getattr(one.separated, name), one.truth) for one in found)
            for name in ("target", "plain")
        )
        labels = (CAMERA_NAMES[encoder], found[0].scene.title, f"{ratio:g}")
        rows += [Row((*labels, "what it hides"), target, paper), Row((*labels, "nothing"), plain)]
        if not panels[scene]:
            panels[scene] += [
                Panel("one view", found[0].pictures[3].sum(axis=-1)),
                Panel("truth", found[0].truth),
            ]
        panels[scene].append(
            Panel(f"{labels[0]}, SR = {labels[2]}\n{target[0]:.1f} %", found[0].separated.target)
        )
    columns = ("camera", "scene", "SR", "the model knows of the occluder")
    return Outcome(columns, "NMSE, %", tuple(rows), tuple(tuple(panels[scene]) for scene in SCENES))


STUDY = Study(
    "table7-flash",
    (),
    "Through occluders by time of flight",
    "Unlike the paper's black occluders these send more light back than the target, and a time gate takes it away; "
    "photon noise is added, the prior's weight fixed. Errors are over the whole frame against the target without its "
    "occluder, a harder truth than the paper's, which is shift-and-add of the occluded views; a model that knows "
    "nothing of the occluder leaves the target dim where few views see it.",
    50,
    len(SCENES) * len(PAPER_NMSE_PERCENT) * len(RATIOS),
    run_flash_occlusion,
)
