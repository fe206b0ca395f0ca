import numpy as np
import pytest
import torch

from models.encoder.evae import EventVAE
from models.encoder.frozen import encoder_part, read_encoder_part, tabulate
from models.encoder.table import EncoderTable
from models.encoder.weights import save_encoder
from tests.support.policies import make_windows


@pytest.fixture
def evae():
    torch.manual_seed(0)
    return EventVAE(width=16, height=16, context=64, time_bins=32).freeze()


def test_the_flying_half_of_an_encoder_gives_the_table_of_the_whole(evae):
    windows = make_windows(np.random.default_rng(8), 10)
    whole = EncoderTable.from_evae(evae).encode_windows(windows)
    part = tabulate(encoder_part(evae), evae.settings)
    np.testing.assert_array_equal(part.encode_windows(windows), whole)


def test_the_flying_half_is_all_buffers_and_without_the_decoder(evae):
    part = encoder_part(evae)
    assert list(part.parameters()) == []
    assert not [name for name in part.state_dict() if name.startswith("decoder")]
    assert not part.training


def test_an_encoder_whose_file_is_missing_or_changed_does_not_fly(tmp_path, evae):
    path = str(tmp_path / "encoder.safetensors")
    missing = read_encoder_part(path, "0" * 64, evae.settings)
    save_encoder(path, evae, {})
    changed = read_encoder_part(path, "0" * 64, evae.settings)
    for part in (missing, changed):
        with pytest.raises(ValueError, match="its file is missing or changed"):
            tabulate(part, evae.settings)
