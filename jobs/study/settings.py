"""The settings of a study, each a file of conf/exp."""

from typing import Annotated, Any, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from envs.config import STRICT
from jobs.config.conditions import Axis, AxisName
from jobs.config.schema import Count, Name


@dataclass(frozen=True, config=STRICT)
class Settings:
    """Which policies are trained or taken, under which conditions they are evaluated, and what is asked.

    Attributes:
        policies: Policies to evaluate as they are, each a group or a name in models/pretrained, "pretrained"
            (all there), "newest", a baseline, or a path.
        scene: The layout, unless an axis changes it.
        split: Whose corridors: "eval" for results, or "validation" for choosing settings.
        trials: Corridors for each training and condition.
        axes: Name -> setting -> values. The first setting names the points of the axis; others have as many
            values, or one that stays.
        reference: The group that paired differences are taken against; null: none.
        seeds: Of the trainings of each variant.
        variants: Name -> what it changes, key -> value, with the place in a list as a number. `train.init`
            names the first variant: its policy of the same seed is trained on. `seeds` gives a variant fewer
            trainings. Variants whose encoders learn from the same settings share them, seed by seed;
            `encoder_seed` names one of the seeds: all trainings of the variant see by the encoder of that
            seed. `tags` are facts for the families, `published` as below.
        published: Where published policies of a group are, but for "-s0" and so on; VARIANT is the group.
        train: Whether the variants are trained; false: the published policies are evaluated.
        families: Name -> tests that are corrected together, or a file of conf/claims (jobs/study/spec.py).
        figures: Name -> kind of figure and its settings (jobs/study/figures.py).
        headline: Axis -> values of the table that readers see first.
        doses: Axis -> the event errors that its points stand for; null: they are only measured.
        spread: The two random factors that variants and seeds cross; null: none.
    """

    policies: list[Name]
    scene: Name
    split: Literal["eval", "validation"]
    trials: Count
    axes: dict[AxisName, Axis]
    reference: Name | None
    seeds: Annotated[list[Annotated[int, Field(ge=0, lt=2**31)]], Field(min_length=1)]
    variants: dict[AxisName, dict[str, Any]]
    published: str | None
    train: bool
    families: dict[AxisName, Any]
    figures: dict[AxisName, dict[str, Any]]
    headline: dict[AxisName, list[Any]]
    doses: dict[AxisName, list[float] | None]
    spread: dict[str, str] | None
