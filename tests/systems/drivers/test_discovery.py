"""The tables of own drivers and jobs hold every module that there is, and a scenario imports those that it names."""

from __future__ import annotations

import importlib

import pytest
from pydrake.common.yaml import yaml_load

from tests.places import ROOT
from weldcal.models.errors import InputError
from weldcal.systems.drivers.config import DEVICES, NoDevice
from weldcal.systems.drivers.discovery import DEFAULTS, OWN, driver_configs
from weldcal.systems.drivers.ur.rtde import UrRtde
from weldcal.systems.jobs.job import JOBS, job_at, job_keys
from weldcal.systems.scenario.loading import load_scenario, scenario_text


def test_every_driver_is_in_the_table_under_its_name() -> None:
    folder = ROOT / "systems" / "drivers"
    written = {
        ".".join(path.relative_to(folder).with_suffix("").parts)
        for path in folder.rglob("*.py")
        if "\ndef ApplyDriverConfig(" in path.read_text()
    }
    assert set(OWN.values()) == written
    configs = {config.__name__: config for device in DEVICES for config in driver_configs(device)}
    assert set(configs) - {NoDevice.__name__} == set(OWN)
    assert {name for name, config in configs.items() if config.DEFAULT_FOR} == DEFAULTS
    for tag, module in OWN.items():
        assert configs[tag].__module__ == f"weldcal.systems.drivers.{module}"


def test_every_job_is_in_the_table_under_its_key() -> None:
    written = {path.parent.name for path in (ROOT / "systems" / "jobs").glob("*/job.py")}
    assert sorted(JOBS.values()) == sorted(written)
    for key, folder in JOBS.items():
        assert (job_at(key).key, importlib.import_module(f"weldcal.systems.jobs.{folder}.job").JOB) == (
            key,
            job_at(key),
        )
    assert job_keys() == tuple(sorted(key for key in JOBS if key))


def test_a_robot_that_replaces_the_files_own_is_written_too() -> None:
    scenario = load_scenario("s_groove")
    scenario.robot = UrRtde(host="10.0.0.7")
    assert yaml_load(data=scenario_text(scenario))["robot"]["host"] == "10.0.0.7"


def test_a_driver_of_another_device_is_refused_with_every_known_one() -> None:
    with pytest.raises(InputError, match=r"no driver '!UrRtde'.*!FolderScanner, !GenicamScanner"):
        load_scenario("s_groove", "scanner: !UrRtde {}")
