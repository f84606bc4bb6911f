import os

import torch

from torchbokeh.report import machine as module
from torchbokeh.report.machine import machine, processor, processors


def test_it_says_what_a_reader_of_run_times_asks_for():
    found = machine()
    assert found["torch"] == torch.__version__
    assert found["threads"] == torch.get_num_threads()
    assert 1 <= found["processors"] <= (os.cpu_count() or 1)
    assert all(found.values())


def test_a_package_that_is_not_installed_is_named(monkeypatch):
    monkeypatch.setattr(module, "PACKAGES", ("torch", "no-such-package-anywhere"))
    assert machine()["no-such-package-anywhere"] == "not installed"


def test_systems_without_proc_have_a_processor_too(monkeypatch, tmp_path):
    monkeypatch.setattr(module, "Path", lambda name: tmp_path / "nothing")
    assert processor()
    monkeypatch.setattr(module.sys, "platform", "win32")
    assert processors() >= 1
