"""Does each rig keep its calibration, and what do options make of the calibration of a scan?

Method: a trial is one run of `sfm-calib calibrate`, `recalibrate` or `target`, on a scan or on a
simulated one, with any of the command's options, which may all be swept. It leaves what the command
leaves in OUT/trials/KEY; features, matches and models are made once for all trials that share them.
configs/fleet.yaml is for rigs of yours; the fleet below is simulated.
Expectation: none; with a truth, errors no larger than the stated sigmas let expect.
Source: none.
Run: sfm-calib run configs/studies/calibrations.yaml -o out/calibrations
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from experiments.calibration_answer import answer
from experiments.calibration_options import (
    LIKE,
    SEED,
    TAKEN,
    CalibrationOptions,
    CalibrationTrial,
)
from experiments.calibration_rows import row_of, truth_columns
from experiments.calibration_sources import Source, Tracks, source_of, unwatched
from experiments.runner.protocol import Row, Study
from sfm_calib.anchors import calibrate_with_board
from sfm_calib.cache import Cache
from sfm_calib.calibrate import Outcome, Stopwatch, calibrate, determine, enough_placed
from sfm_calib.cli import flag, rig_file
from sfm_calib.colmap import quiet
from sfm_calib.config import Options, RigConfig, TargetOptions
from sfm_calib.drift import DriftOptions
from sfm_calib.files import RESULT_FILE, calibration_files, refuse_overwrite
from sfm_calib.formats import CameraRig
from sfm_calib.formats.ours import rig_of
from sfm_calib.mapping import Mapped
from sfm_calib.nominal import check_config, start_from_config
from sfm_calib.output import check_apart, dated, output_folder, told, write_results
from sfm_calib.recalibrate import RecalibrateOptions, recalibrate, recalibrate_scan
from sfm_calib.result import save_calibration
from sfm_calib.run import Given
from sfm_calib.target import calibrate_target, with_lenses

CACHE = "cache"  # beside the folders of the trials


def trial(options: CalibrationOptions, seed: int, folder: Path) -> Row:
    """Calibrate, and leave calibration.json and report.html in `folder`.

    Raises CalibrationError as the command.
    """
    quiet(False)
    if options.scan:
        check_apart(options.scan, folder)
    if options.old:
        refuse_overwrite(options.old, folder, overwrite=False)
    with output_folder(folder):
        cache = Cache(folder.parent / CACHE, shared=True)
        source = source_of(options, seed, folder, cache)
        line = line_of(options, source, seed, folder)
        outcome = dated(outcome_of(options, source, seed, cache, line))
        if options.report:
            write_results(outcome, folder, ())
        else:
            save_calibration(outcome.calibration, folder / RESULT_FILE)
    row = row_of(outcome.calibration)
    if source.truth is None:
        return row
    return {**row, **truth_columns(rig_of(outcome.calibration, folder / RESULT_FILE), source.truth)}


def outcome_of(
    options: CalibrationOptions, source: Source, seed: int, cache: Cache, line: str
) -> Outcome:
    """What the command makes of a source; options go before its rig.yaml."""
    scan, board = source.scan, source.load_board()
    seeded = {SEED: source.config.seed + seed}
    if options.command == "target":
        assert isinstance(scan, Path) and board is not None
        asked = source.config.target_options().model_copy(
            update=options.given(TargetOptions) | seeded
        )
        config = source.config.with_options(asked)
        return calibrate_target(scan, board, asked, config, cache, unwatched, line)
    config = source.config.model_copy(update=options.given(Options) | seeded)
    if options.command == "recalibrate":
        return recalibrated(options, source, config, cache, line)
    if isinstance(scan, Tracks):
        return of_tracks(scan, config, line)
    if board is None:
        return calibrate(scan, config, cache, unwatched, line)
    return calibrate_with_board(scan, board, options.board_images, config, cache, unwatched, line)


def recalibrated(
    options: CalibrationOptions, source: Source, config: RigConfig, cache: Cache, line: str
) -> Outcome:
    """The new calibration, with the verdict on the old one."""
    assert source.old is not None
    scan, given = source.scan, options.part(RecalibrateOptions)
    drift = options.part(DriftOptions)
    if isinstance(scan, Path):
        return recalibrate(source.old, scan, config, given, drift, cache, unwatched, line).outcome

    def mapping(old: CameraRig, config: RigConfig) -> Mapped:
        return Mapped(with_lenses(scan.problem, config), (), {})

    return recalibrate_scan(
        source.old, scan.scan, mapping, config, given, drift, unwatched, line, Stopwatch()
    ).outcome


def of_tracks(tracks: Tracks, config: RigConfig, line: str) -> Outcome:
    """A calibration from tracks that need no mapping."""
    check_config(config, tracks.scan)
    mapped = Mapped(with_lenses(tracks.problem, config), (), {})
    given = Given(tracks.scan, config, mapped, line)
    with enough_placed(mapped.problem, len(tracks.scan.images)):
        problem = start_from_config(mapped.problem, config)
        return determine(given, problem, Stopwatch(), unwatched)


def line_of(options: CalibrationOptions, source: Source, seed: int, folder: Path) -> str:
    """The command line that does the same, as far as one does."""
    if isinstance(source.scan, Tracks):
        return ""
    words: list[Any] = [options.command, *([source.old.path] if source.old else []), source.scan]
    words += ["-o", folder]
    for key, path in (("board", source.board), ("board_images", options.board_images)):
        words += [flag(key), path] if path else []
    for model in TAKEN[options.command]:
        for key, value in options.given(model).items():
            words += [flag(key), *(value if isinstance(value, tuple) else (value,))]
    words += [flag(SEED), source.config.seed + seed]
    return told([os.fspath(word) if isinstance(word, Path) else str(word) for word in words])


def inputs(options: CalibrationOptions) -> Sequence[Path]:
    """Scan, rig.yaml, old calibration, board and truth."""
    return tuple(_inputs(options))


def _inputs(options: CalibrationOptions) -> Iterator[Path]:
    if options.scan:
        yield options.scan
        if options.scan.is_file() and rig_file(options.scan).exists():  # else it is in the scan
            yield rig_file(options.scan)
    if options.old:  # a folder of results holds a report and a cache as well
        yield from calibration_files(options.old)
    for path in (options.board, options.board_images, options.truth, options.said.get(LIKE)):
        if path:
            yield path


STUDY: Study[CalibrationOptions] = Study(CalibrationTrial, trial, answer, inputs, folder=True)
