"""An encoder that learns on inside a policy: rows of events in, the latents of their windows out.

What a policy keeps of each step is then its events, thinned to `EVENTS`, and the event context
network and the mean of the latent are the trunk of its networks. Before the first update the
latents are those of the frozen encoder, for windows that fit. The context network runs in its
fused form (`models.encoder.context`), once per distinct (x, y, p) of a minibatch.
"""

from collections.abc import Mapping
from typing import Any

from torch import Tensor, nn

from models.encoder.evae import EventVAE, check_settings
from models.encoder.event_batch import batch_rows
from models.kinds import MAX_TIME_BINS

EVENTS = 1024  # of a window; at 200 Hz in the poles a window has 310 (median), one in 16 has more
SETTINGS = ("width", "height", "context", "latent", "norm", "target", "time_bins", "coding")


class FinetunedEncoder(nn.Module):
    """Latents float32 (B, stack * latent) of stacks of rows of events, int16 (B, stack, EVENTS, 4).

    Always in eval mode: the running statistics of the normalisation stay those of the
    pretraining, its weights and biases learn. Tensors have the names that they have in an
    encoder file; the half of the last layer that gives deviations has no gradient.
    """

    def __init__(self, settings: Mapping[str, Any]) -> None:
        """Make it for a policy's settings (`evae_settings`); its weights mean nothing yet."""
        super().__init__()
        evae = EventVAE(**evae_settings(settings))
        self.ecn, self.encoder = evae.ecn, evae.encoder
        self.eval()

    def train(self, mode: bool = True) -> "FinetunedEncoder":
        """Stay in eval mode."""
        return super().train(False)

    def forward(self, stacks: Tensor) -> Tensor:
        """Latents of all windows, oldest first.

        Raises:
            ValueError: A row is no event of the sensor.
        """
        batch = batch_rows(stacks.flatten(0, 1).cpu().numpy(), self.ecn.grid)
        mu, _ = self.encoder(self.ecn(batch)).chunk(2, dim=-1)
        return mu.reshape(len(stacks), -1)


def evae_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of the event VAE whose encoder a policy fine-tunes.

    Raises:
        ValueError: One is missing or out of its range.
    """
    missing = [name for name in SETTINGS if name not in settings]
    if missing:
        raise ValueError(f"a fine-tuned encoder needs {', '.join(missing)}")
    values = {"variant": settings["name"], **{name: settings[name] for name in SETTINGS}}
    check_settings(values)
    if values["time_bins"] > MAX_TIME_BINS:
        raise ValueError(f"time_bins must be at most {MAX_TIME_BINS} to be kept, got {values['time_bins']}")
    return values
