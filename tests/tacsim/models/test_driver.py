"""The registry of drivers: what is refused, and why. Whole drivers: tests/contract/test_outside_driver.py."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from importlib import metadata
from types import ModuleType
from typing import Literal

import pytest

from tacsim.models import driver as drivers
from tacsim.models.driver import ArmPart, Drivers, DriversMissing, installed_drivers
from tacsim.models.hardware import ArmConfig, UrArmConfig
from tacsim.models.rig import SimArmConfig


class CraneConfig(ArmConfig):
    driver: Literal["crane"]


class Crane(ArmPart[CraneConfig]):
    config_class = CraneConfig
    clocks = ("sim",)


class WallCrane(Crane):
    clocks = ("wall",)


SILENT = type("Silent", (drivers.ArmDriver,), {"config_class": CraneConfig})
NAMELESS = type("Nameless", (ArmPart,), {"clocks": ("sim",)})
OTHER = type("Other", (Crane,), {"config_class": SimArmConfig})


@dataclass
class Distribution:
    name: str


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> dict[str, object]:
    """Entry points of the group, by "distribution: name"; each leads to what it is given."""
    found: dict[str, object] = {}
    module = ModuleType("somebodys")
    monkeypatch.setitem(sys.modules, "somebodys", module)

    def entry_points(group: str) -> list[metadata.EntryPoint]:
        made = []
        for number, (key, value) in enumerate(found.items()):
            home, _, name = key.partition(": ")
            setattr(module, f"thing_{number}", value)
            entry = metadata.EntryPoint(name, f"somebodys:thing_{number}", group)
            vars(entry).update(dist=Distribution(home))
            made.append(entry)
        return made

    monkeypatch.setattr(metadata, "entry_points", entry_points)
    return found


def look_up() -> Drivers:
    return installed_drivers.__wrapped__()


def test_registry_with_a_sound_driver_finds_it(registered: dict[str, object]) -> None:
    registered["tacsim: arm.crane"] = Crane
    found = look_up()
    assert found.usable["arm"] == {"crane": Crane} and found.refused["arm"] == {}


@pytest.mark.parametrize(
    ("thing", "words"),
    [
        (object(), "is no class that derives from tacsim.ArmDriver"),
        (CraneConfig, "is no class that derives from tacsim.ArmDriver"),
        (WallCrane, "goes by the wall clock and does not derive from tacsim.ArmDriver"),
        (SILENT, "does not state examine, open, worst_latency, so how deep a gel is pressed"),
        (NAMELESS, 'has no config_class with `driver: Literal["crane"]`'),
        (OTHER, 'has no config_class with `driver: Literal["crane"]`'),
    ],
)
def test_registry_with_an_unsound_driver_refuses_it(registered: dict[str, object], thing: object, words: str) -> None:
    registered["tacsim: arm.crane"] = thing
    found = look_up()
    assert found.usable["arm"] == {} and words in found.refused["arm"]["crane"]


def test_registry_with_one_name_twice_refuses_both(registered: dict[str, object]) -> None:
    registered |= {"tacsim: arm.crane": Crane, "other: arm.crane": Crane}
    found = look_up()
    assert found.usable["arm"] == {}
    assert found.refused["arm"]["crane"] == "other and tacsim both bring one; uninstall one of them"


@pytest.mark.parametrize(
    ("key", "words"),
    [
        (
            "other: arms.crane",
            "other calls it 'arms.crane' in the group tacsim.drivers; call it one of 'sensor.crane', 'arm.",
        ),
        ("other: arm.crane", "goes by the clocks ('sim',); simulations and replays have drivers of tacsim alone"),
    ],
)
def test_registry_with_a_driver_that_no_rig_would_open_refuses_it(
    registered: dict[str, object], key: str, words: str
) -> None:
    registered |= {"tacsim: arm.boom": Crane, key: Crane}
    found = look_up()
    assert found.usable["arm"] == {} and words in found.refused["arm"]["crane"]


def test_registry_without_the_shipped_drivers_says_what_to_run(registered: dict[str, object]) -> None:
    registered["other: arm.crane"] = Crane
    with pytest.raises(DriversMissing, match=r"pip install -e \. --no-deps --no-build-isolation"):
        look_up()


def test_weakened_limits_of_an_arm_of_another_driver_name_the_driver() -> None:
    arm = UrArmConfig.model_validate(
        {
            "driver": "ur",
            "host": "192.0.2.1",
            "world_from_base": {},
            "limits": {"workspace": {"lower": (0, 0, 0), "upper": (1, 1, 1)}},
        }
    )
    assert arm.weakened_limits(SimArmConfig(driver="sim")) == ["driver: sim -> ur"]
    assert arm.weakened_limits(arm) == []
