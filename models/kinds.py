"""Which policies there are: what each one sees, what it keeps of that, what decides (appendix D.1.2).

    observation --feature, once per step--> stack of the last ones --network--> logits and value

The words of a row name the entries of other tables: `envs.observations`, `models.features.FEATURES`
and `models.networks.NETWORKS`. Imports nothing, so that a configuration is checked in no time.
"""

from typing import NamedTuple


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
    "brp_full": Kind("window", "latent", "mlp", encoder=True),
    "brp_xy": Kind("window", "latent", "mlp", encoder=True),
    "event_columns": Kind("window", "columns", "mlp", encoder=False),
    "event_set": Kind("window", "events", "set", encoder=False),
    "eip": Kind("event_image", "event_image", "cnn", encoder=False),
    "eivae": Kind("window", "latent", "mlp", encoder=True),
    "rgb": Kind("luminance", "grey", "cnn", encoder=False),
}
SMALLEST_IMAGE = 36  # pixels, of the picture that leaves the third convolution of "cnn" one pixel
