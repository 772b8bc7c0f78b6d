"""kornia's networks with random weights, in files as their authors' are."""

import numpy as np
import pytest


def random_weights(name, place, seed=0):
    """A file with weights of these features, drawn at random; its path."""
    torch, features = import_or_skip()
    torch.manual_seed(seed)
    if name == "xfeat":
        path, content = place / "xfeat.pt", features.XFeat().net.state_dict()
        content["keypoint_head.3.weight"] *= 30  # else no pixel of 64 is more likely than others
    elif name == "aliked":
        path, content = place / "aliked-n16rot.pth", features.ALIKED().state_dict()
        del content["dkd.hw_grid"]  # the published file has none
    else:
        path = place / "disk-depth-save.pth"
        content = {"extractor": features.DISK().state_dict()}
    torch.save(content, path)
    return path


def random_lightglue(name, place):
    """A file with weights of LightGlue, named as in the published file of XFeat, or of DISK."""
    torch, features = import_or_skip()
    torch.manual_seed(0)
    shape = {k: v for k, v in features.LightGlue.features[name].items() if k != "weights"}
    content = features.LightGlue(None, **shape).state_dict()
    del content["confidence_thresholds"]
    if name == "xfeat":
        content = {f"matcher.{key}": value for key, value in content.items()}
        content["extractor.model.net.skip1.1.weight"] = torch.zeros(1)
    elif name == "disk":
        content = {_by_block(key): value for key, value in content.items()}
        content["log_assignment.0.r"] = torch.zeros(1)
    path = place / f"{name}_lightglue.pth"
    torch.save(content, path)
    return path


def _by_block(key):
    layers, number, block, *inner = (*key.split("."), "", "")
    if layers != "transformers":
        return key
    return ".".join([block, number, *(part for part in inner if part)])


def import_or_skip():
    """torch and kornia.feature; the test is skipped where they are not installed."""
    torch = pytest.importorskip("torch", reason="the extra `learned` is not installed")
    return torch, pytest.importorskip("kornia.feature", reason="kornia is not installed")


def blobs(size, sigma, seed=0, spacing=40):
    """An image (h, w, 3) of blobs of this sigma, and their centres (n, 2) in px."""
    rng, (width, height) = np.random.default_rng(seed), size
    x, y = np.meshgrid(*(np.arange(spacing, s - spacing // 2, spacing) for s in size))
    centres = np.stack([x.ravel(), y.ravel()], 1) + rng.uniform(-3, 3, (x.size, 2))
    across, down = np.arange(width), np.arange(height)
    image = sum(
        np.exp(-((down - cy) ** 2)[:, None] / (2 * sigma**2) - (across - cx) ** 2 / (2 * sigma**2))
        for cx, cy in centres
    )
    return np.repeat((20 + 220 * image).round().astype(np.uint8)[..., None], 3, 2), centres
