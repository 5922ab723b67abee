"""A machine whose own LLVM is missing or too old: every entry says what mends it, and computes nothing."""

import os
import re
import subprocess
import sys
from pathlib import Path

import mi_radiosity as mr
from mi_radiosity.cli import main
from mi_radiosity.core import llvm
from mi_radiosity.scene import Model

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.fast

needs_wheel = pytest.mark.skipif(not llvm._files("libLLVM"), reason=f"{llvm.WHEEL} is not installed")
BOX = "scenes_xml/cornell_box.xml"


@pytest.fixture
def pretend(monkeypatch):
    """pretend(version): Dr.Jit has loaded that LLVM (None: has found none), and no choice was made."""
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)

    def pretend(version):
        monkeypatch.setattr(dr, "has_backend", lambda backend: version is not None)
        monkeypatch.setattr(dr.detail, "llvm_version", lambda: version)

    return pretend


@pytest.mark.parametrize("version", [(17,), (17, 0, 6), (23, 1, 4)])
def test_new_enough(pretend, version):
    pretend(version)
    assert llvm.problem() is None


@needs_wheel
@pytest.mark.parametrize("version, says", [(None, "no LLVM"), ((15, 0, 6), "15.0.6"), ((16, 9, 9), "16.9.9")])
def test_names_the_cure(pretend, version, says):
    """Both cures; the line for the shell names the very library that pip installed."""
    pretend(version)
    message = llvm.problem()
    assert says in message and "import mi_radiosity before" in message and "\n" not in message
    assert Path(re.search(r"`export DRJIT_LIBLLVM_PATH=(.+?)`", message)[1]).is_file()


def test_names_the_library_that_was_chosen(pretend, monkeypatch):
    pretend((15, 0, 6))
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/opt/old/libLLVM.so")
    assert "DRJIT_LIBLLVM_PATH is /opt/old/libLLVM.so" in llvm.problem() and "unset it" in llvm.problem()


def test_without_the_wheel(pretend, monkeypatch):
    pretend((15, 0, 6))
    monkeypatch.setattr(llvm, "_files", lambda pattern: [])
    assert f"pip install {llvm.WHEEL}" in llvm.problem() and "set DRJIT_LIBLLVM_PATH" in llvm.problem()


def test_other_variants_need_no_llvm(pretend):
    """What is wrong with a variant is said before what is wrong with LLVM."""
    pretend(None)
    mi.set_variant("scalar_rgb")
    try:
        with pytest.raises(mr.RadiosityError, match="choose llvm_ad_rgb"):
            llvm.require_variant()
    finally:
        mi.set_variant("llvm_ad_rgb")


# ---- Every public entry ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def saved(cornell, tmp_path_factory):
    file = tmp_path_factory.mktemp("llvm") / "saved.npz"
    mr.solve(cornell, elements=200, rays=1000).save(file)
    return file


ENTRIES = {
    "information_gap of an array": lambda scene, file: mr.information_gap(np.ones((2, 3)), 0.5),
    "information_gap of samples": lambda scene, file: mr.information_gap(
        mr.KernelSamples(mi.Float64([1, 2, 3, 4]), 2), 0.5
    ),
    "solve": lambda scene, file: mr.solve(scene, elements=200, rays=1000),
    "Solution.load": lambda scene, file: mr.Solution.load(file, scene),
    "Model": lambda scene, file: Model(scene),
    "plugin": lambda scene, file: mi.load_dict({"type": "radiosity", "elements": 200, "rays": 1000}).render(scene),
}


@pytest.mark.parametrize("entry", ENTRIES)
def test_every_entry_asks(entry, cornell, saved, pretend):
    """RadiosityError with the cure, before any kernel runs: a kernel is what aborts the process there."""
    pretend((15, 0, 6))
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        with pytest.raises(mr.RadiosityError, match=re.escape(llvm.problem())):
            ENTRIES[entry](cornell, saved)
        assert not dr.kernel_history((dr.KernelType.JIT,))


def test_the_command_line_asks(pretend, capsys, tmp_path):
    pretend((15, 0, 6))
    assert main(["render", BOX, "-o", str(tmp_path / "x.png")]) == 2
    message = capsys.readouterr().err
    assert llvm.problem() in message and message.count("\n") == 1


# ---- In a process of its own -----------------------------------------------------------------------

DRJIT_FIRST = """
import drjit as dr
if {pretend}:
    dr.has_backend, dr.detail.llvm_version = lambda backend: True, lambda: (15, 0, 6)
import mitsuba as mi
import mi_radiosity as mr
mi.set_variant("llvm_ad_rgb")
try:
    print(mr.information_gap([[1.0, 3.0]], 2.0))
except mr.RadiosityError as error:
    print(error)
"""


def run(pretend, **environment):
    """What a process that imports drjit first prints, with no choice made but that of ``environment``."""
    kept = {k: v for k, v in os.environ.items() if k != "DRJIT_LIBLLVM_PATH"} | environment
    process = subprocess.run(
        [sys.executable, "-c", DRJIT_FIRST.format(pretend=pretend)],
        env=kept | {"PYTHONPATH": os.getcwd()},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert process.returncode == 0, process.stderr
    return process.stdout.strip()


@needs_wheel
def test_the_cure_that_is_printed_works():
    """drjit imported first on a machine with an old LLVM: one line; after its `export` the same program computes."""
    message = run(True)
    cure = re.search(r"LLVM 15\.0\.6 .*import mi_radiosity before .*`export DRJIT_LIBLLVM_PATH=(.+?)`$", message)
    assert cure, message
    assert run(False, DRJIT_LIBLLVM_PATH=cure[1]) == "[1]"  # ((1 + 9)/2 − 2²)/(2 − 1)
