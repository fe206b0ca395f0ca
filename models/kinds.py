"""Which policies there are: what each one sees, what it keeps of that, what decides (appendix D.1.2).

    observation --feature, once per step--> stack of the last ones --network--> logits and value

The words of a row name the entries of other tables: `envs.observations`, `models.policy.features.FEATURES`
and `models.policy.networks.NETWORKS`. Imports no package, so that a configuration is checked in no time.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple


class Kind(NamedTuple):
    """How a policy turns observations into decisions.

    Attributes:
        observation: What the environment shows it.
        feature: What is kept of each step.
        network: What reads the stack of features.
        encoder: Whether a frozen event VAE makes the feature.
    """

    observation: str
    feature: str
    network: str
    encoder: bool


KINDS = {
    "bytestream": Kind("window", "latent", "mlp", encoder=True),
    "bytestream_xy": Kind("window", "latent", "mlp", encoder=True),
    "event_columns": Kind("window", "columns", "mlp", encoder=False),
    "event_set": Kind("window", "events", "set", encoder=False),
    "event_image": Kind("event_image", "event_image", "cnn", encoder=False),
    "event_image_vae": Kind("window", "latent", "mlp", encoder=True),
    "rgb": Kind("luminance", "grey", "cnn", encoder=False),
}
# With `encoder: finetuned` the events are kept, and the encoder learns on as part of the network.
FINETUNED = {
    name: KINDS[name]._replace(feature="event_rows", network="finetuned", encoder=False)
    for name in ("bytestream", "bytestream_xy")
}
MAX_TIME_BINS = 1 << 15  # of an encoder that learns on: events are kept as rows of int16
MIN_IMAGE = 36  # pixels, of the picture that leaves the third convolution of "cnn" one pixel


def kind_of(settings: Mapping[str, Any]) -> Kind:
    """The kind that a policy's settings (`name`, `encoder`) name; `KINDS` has it before any fine-tuning."""
    kinds = FINETUNED if settings.get("encoder") == "finetuned" else KINDS
    return kinds[settings["name"]]
