"""The settings of a study, each a file of conf/exp."""

from typing import Annotated, Any, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from envs.config import STRICT
from jobs.config.conditions import Axis, AxisName
from jobs.config.schema import Count, Name


@dataclass(frozen=True, config=STRICT)
class Settings:
    """Policies to train or take, conditions to evaluate them under, and tests to make of the results.

    Attributes:
        policies: Policies to evaluate as they are: each a group or a name in models/pretrained, "pretrained"
            (all there), "newest", a baseline, or a path.
        scene: The layout, unless an axis changes it.
        split: Corridors to fly in: "eval" for results, "validation" for choosing settings.
        trials: Corridors for each training and condition.
        axes: Name -> setting -> values. The values of the first setting name the points of the axis. Every
            other setting has one value per point, or a single value for all.
        reference: The group that paired differences are taken against; null: none.
        seeds: Training seeds of each variant.
        variants: Name -> changed settings, key -> value; a number in a key is a place in a list.
            `train.init` must name the first variant: training then continues from its policy with the same
            seed. `seeds` gives a variant fewer trainings. Variants whose encoders learn from the same
            settings share these encoders, seed by seed; `encoder_seed` makes all trainings of a variant use
            the encoder of that one seed. `tags` are facts for the families; `published` as below.
        published: Path of a group's published policies without "-s0" and so on; VARIANT stands for the group.
        train: Whether to train the variants; false: evaluate the published policies.
        families: Name -> tests that are corrected together, or a file of conf/claims (jobs/study/spec.py).
        figures: Name -> kind of figure and its settings (jobs/study/figures.py).
        headline: Axis -> values that the first table on the page shows.
        doses: Axis -> intended event error of each point; null: event errors are only measured.
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
