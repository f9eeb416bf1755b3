"""`tacsim collect samples`: presses to try `calibrate` and `compare` without a sensor."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import numpy as np
import pytest

from calibration.light.dent import find_contact_circle
from robot.studies.sample_presses import PRESSES, SERIES
from tacsim.record.images import read_image
from tests.robot.cli.invoked import tacsim

pytestmark = pytest.mark.usefixtures("empty_folder")


@pytest.mark.slow
def test_samples_are_calibrated_and_compared_by_the_commands_that_are_printed() -> None:
    drawn = tacsim("collect", "samples", "--out", "s")
    assert drawn.exit_code == 0, drawn.output
    assert {path.name for path in Path("s/sensor").iterdir()} == {
        *("background.png", "background_2.png", "background_3.png", "background_4.png"),
        *(f"press_{k}.png" for k in range(len(PRESSES))),
    }
    lengths = json.loads(Path("s/lengths.json").read_text("utf-8"))
    pitch, untouched = lengths["pixel_pitch"], read_image(Path("s/sensor/background.png"))
    for press in lengths["presses"]:
        image = read_image(Path("s/sensor") / press["frame"])
        circle = find_contact_circle(image, untouched, lengths["ball_radius"] / pitch)
        middle = (np.array(untouched.shape[1::-1]) - 1) / 2
        found = (np.array([circle.x, circle.y]) - middle) * pitch
        np.testing.assert_allclose(found, press["centre"], atol=0.1e-3)

    printed = dict(line.split(": tacsim ", 1) for line in drawn.stderr.splitlines() if ": tacsim " in line)
    calibrated = tacsim(*shlex.split(printed["calibrate"]), "--out", "bundle")
    assert calibrated.exit_code == 0, calibrated.output
    assert "verdict: good" in calibrated.output or "verdict: usable" in calibrated.output
    compared = tacsim(*shlex.split(printed["compare"]), "--calibration-b", "bundle", "--out", "compared")
    assert compared.exit_code == 0 and "In contact A looks like B" in compared.output, compared.output
    assert "look at this: s/sensor" not in compared.output  # no doubt about the pictures without contact

    again = tacsim("collect", "samples", "--out", "s")
    assert again.exit_code == 2 and "s exists already" in again.output


@pytest.mark.slow
def test_samples_are_the_same_each_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("robot.studies.sample_presses.PRESSES", PRESSES[:1])
    for name in ("a", "b"):
        assert tacsim("collect", "samples", "--out", name).exit_code == 0
    for folder in SERIES:
        for path in Path("a", folder).iterdir():
            assert path.read_bytes() == Path("b", folder, path.name).read_bytes()
