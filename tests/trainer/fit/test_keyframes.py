from dataclasses import replace

import pytest
import torch

from progdf.color.oklab import srgb_to_oklab
from progdf.field import fit_keyframes
from progdf.field.baked import SliderRemap
from progdf.sh import C0
from trainer.fit.keyframes import TwoKeyframes


def test_oklab_keyframes_match_raw_ends_and_are_straight_between() -> None:
    rng = torch.Generator().manual_seed(0)
    start = torch.randn(50, 14, generator=rng)
    end = torch.randn(50, 14, generator=rng)
    # float32 through cubes and cube roots, which are steep at black
    moved = TwoKeyframes(start, end, ("sh0",), in_oklab=True)
    torch.testing.assert_close(moved.offsets(1e-6), torch.zeros_like(end), atol=1e-4, rtol=0)
    assert not moved.offsets(0.0).any()
    assert torch.equal(moved.offsets(1.0), end)
    gray = torch.full((1, 14), 0.0)
    blue = torch.zeros(1, 14)
    blue[0, 11:14] = torch.tensor([-0.3, -0.1, 0.4]) / C0
    half = 0.5 + C0 * TwoKeyframes(gray, blue, ("sh0",), in_oklab=True).offsets(0.5)[0, 11:14]
    ends = srgb_to_oklab(torch.tensor([[0.5, 0.5, 0.5], [0.2, 0.4, 0.9]]))
    torch.testing.assert_close(srgb_to_oklab(half), ends.mean(dim=0), atol=1e-5, rtol=0)


def test_raw_keyframes_match_the_stored_field() -> None:
    rng = torch.Generator().manual_seed(1)
    start = torch.randn(20, 14, generator=rng)
    end = torch.zeros(20, 14)
    end[:, :3] = torch.randn(20, 3, generator=rng)
    end[:, 11:14] = torch.randn(20, 3, generator=rng)
    stored = fit_keyframes(torch.tensor([0.0, 1.0]), torch.stack([torch.zeros_like(end), end]), 2)
    plain = TwoKeyframes(start, end, tuple(stored.attributes), in_oklab=False)
    assert plain.bytes_per_member == stored.bytes_per_member
    for s in (0.0, 0.3, 1.0):
        torch.testing.assert_close(plain.offsets(s), stored.offsets(s))


@pytest.mark.parametrize("in_oklab", [False, True])
def test_retimed_keyframes_follow_the_slider_remap(in_oklab: bool) -> None:
    rng = torch.Generator().manual_seed(2)
    start = 0.3 * torch.randn(20, 14, generator=rng)
    end = torch.zeros(20, 14)
    end[:, 11:14] = 0.3 * torch.randn(20, 3, generator=rng)
    plain = TwoKeyframes(start, end, ("sh0",), in_oklab)
    ends = torch.tensor([0.0, 0.5, 1.0]).double()
    timed = replace(plain, timing=SliderRemap(ends, torch.tensor([0.0, 0.2, 1.0]).double()))
    torch.testing.assert_close(timed.offsets(0.5), plain.offsets(0.2))
    torch.testing.assert_close(timed.offsets(0.75), plain.offsets(0.6))
    assert torch.equal(timed.offsets(1.0), plain.offsets(1.0))


@pytest.mark.parametrize("bands", [4, 9, 16])
def test_higher_bands_start_and_end_at_the_keyframes(bands: int) -> None:
    rng = torch.Generator().manual_seed(bands)
    channels = 11 + 3 * bands
    start = 0.2 * torch.randn(30, channels, generator=rng)
    end = torch.zeros(30, channels)
    end[:, 11:] = 0.2 * torch.randn(30, 3 * bands, generator=rng)
    keyframes = TwoKeyframes(start, end, ("sh0", "shN"), in_oklab=True)
    torch.testing.assert_close(keyframes.offsets(1e-6), torch.zeros_like(end), atol=1e-4, rtol=0)
    torch.testing.assert_close(keyframes.offsets(1 - 1e-6), end, atol=1e-4, rtol=0)
    assert float((keyframes.offsets(0.5) - 0.5 * end).abs().max()) > 1e-3
    assert keyframes.bytes_per_member == 12.0 * bands
