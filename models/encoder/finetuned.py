"""An encoder that PPO trains on as part of a policy: rows of events in, latents of their windows out.

The feature of each step is then its events, thinned to `EVENTS`, and the trunk of the networks is
the event context network with the mean of the latent. Before the first update the latents are
those of the frozen encoder, for windows that were not thinned. The context network runs in its
fused form (`models.encoder.context`), once per distinct (x, y, p) of a minibatch.
"""

from torch import Tensor, nn

from models.encoder.evae import EventVAE
from models.encoder.event_batch import batch_rows
from models.kinds import EvaeSettings

EVENTS = 1024  # of a window; at 200 Hz in the poles a window has 310 (median), one in 16 has more


class FinetunedEncoder(nn.Module):
    """Latents float32 (B, stack * latent) of stacks of rows of events, int16 (B, stack, EVENTS, 4).

    Always in eval mode: the normalisation's running statistics stay those of pretraining, only its
    weights and biases learn. Tensors are named as in an encoder file; the half of the last layer
    that outputs log variances gets no gradient.
    """

    def __init__(self, settings: EvaeSettings) -> None:
        """Build it with random weights, to be replaced by those of a pretrained encoder."""
        super().__init__()
        evae = EventVAE.of(settings)
        self.ecn, self.encoder = evae.ecn, evae.encoder
        self.eval()

    def train(self, mode: bool = True) -> "FinetunedEncoder":
        """Stay in eval mode."""
        return super().train(False)

    def forward(self, stacks: Tensor) -> Tensor:
        """Return latents of all windows, oldest first.

        Raises:
            ValueError: A row is no event of the sensor.
        """
        batch = batch_rows(stacks.flatten(0, 1).cpu().numpy(), self.ecn.grid)
        mu, _ = self.encoder(self.ecn(batch)).chunk(2, dim=-1)
        return mu.reshape(len(stacks), -1)
