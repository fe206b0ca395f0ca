"""An encoder that PPO finetunes as part of a policy: rows of events in, latents of their windows out.

The feature of each step is its events, thinned to `EVENTS`. The trunk of the networks is the event
context network followed by the layers that output the mean of the latent. Before the first update,
the latents of windows that were not thinned equal the frozen encoder's. The context network runs in
its fused form (`models.encoder.context`), once per distinct (x, y, p) of a minibatch.
"""

from torch import Tensor, nn

from models.encoder.evae import EventVAE
from models.encoder.event_batch import batch_rows
from models.kinds import EvaeSettings

EVENTS = 1024  # most events of a window; at 200 Hz among poles the median is 310, and one in 16 has more


class FinetunedEncoder(nn.Module):
    """Encode stacks of event rows, int16 (B, stack, EVENTS, 4), as latents float32 (B, stack * latent).

    Always in eval mode: the normalisation keeps the running statistics of pretraining, and trains only
    its weights and biases. Tensors are named as in an encoder file. The half of the last layer that
    outputs log variances gets no gradient.
    """

    def __init__(self, settings: EvaeSettings) -> None:
        """Build the encoder with random weights; the caller loads those of a pretrained encoder."""
        super().__init__()
        evae = EventVAE.of(settings)
        self.ecn, self.encoder = evae.ecn, evae.encoder
        self.eval()

    def train(self, mode: bool = True) -> "FinetunedEncoder":
        """Stay in eval mode."""
        return super().train(False)

    def forward(self, stacks: Tensor) -> Tensor:
        """Return the latents of all windows, oldest first.

        Raises:
            ValueError: A row is not an event of the sensor.
        """
        batch = batch_rows(stacks.flatten(0, 1).cpu().numpy(), self.ecn.grid)
        mu, _ = self.encoder(self.ecn(batch)).chunk(2, dim=-1)
        return mu.reshape(len(stacks), -1)
