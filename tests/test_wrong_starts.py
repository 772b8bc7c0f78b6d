import pytest

from experiments.wrong_starts import KINDS, Kind, main


@pytest.mark.slow
def test_a_wrong_start_ends_at_the_optimum(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([Kind("stereo", "radtan", 10, "cauchy")], seeds=2) == [1.0]
    assert "2 of 2" in capsys.readouterr().out


@pytest.mark.slow
def test_every_wrong_start_ends_at_the_optimum() -> None:
    assert main(KINDS, seeds=20) == [1.0] * len(KINDS)
