"""What goes wrong around a solve: threads, processes, interruptions, disks."""

import os
import re
import signal
import subprocess
import sys
import time
import zipfile

import mi_radiosity as mr
from mi_radiosity.evaluation.reference import Reference, render_reference
from mi_radiosity.scene import Model

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import ORACLES

SOLVE = """
import mi_radiosity as mr, drjit as dr, mitsuba as mi, numpy as np, sys
mi.set_variant("llvm_ad_rgb")
dr.set_thread_count({threads})
solution = mr.solve(mi.load_dict(mi.cornell_box()), elements=1500, rays=100_000, seed=5)
np.save(sys.argv[1], np.array(solution.radiosity()))
"""


@pytest.fixture
def threads():
    """dr.set_thread_count, put back afterwards."""
    before = dr.thread_count()
    yield dr.set_thread_count
    dr.set_thread_count(before)


@pytest.mark.parametrize("oracle", ORACLES, ids=str)
def test_threads_do_not_matter(cornell, threads, oracle):
    """One thread and two give the same mesh and the same values to 1e-6."""
    solutions = []
    for count in (1, 2):
        threads(count)
        solutions.append(mr.solve(cornell, oracle, elements=1500, rays=100_000, seed=5))
    one, two = solutions
    np.testing.assert_array_equal(np.array(one.elements.child), np.array(two.elements.child))
    np.testing.assert_allclose(np.array(one.radiosity()), np.array(two.radiosity()), rtol=1e-6)


def test_processes_do_not_matter(tmp_path):
    """Two processes at the same time, one on one thread, give the same values to 1e-6."""
    files = [tmp_path / f"{k}.npy" for k in range(2)]
    runs = [
        subprocess.Popen([sys.executable, "-c", SOLVE.format(threads=k + 1), str(f)], stderr=subprocess.PIPE)
        for k, f in enumerate(files)
    ]
    for run in runs:
        _, said = run.communicate(timeout=300)
        assert run.returncode == 0, said.decode()
    np.testing.assert_allclose(*map(np.load, files), rtol=1e-6)


@pytest.fixture(scope="module")
def solution(cornell):
    return mr.solve(cornell, elements=500, rays=20_000)


def no_space(*args, **kwargs):
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize("call", ["numpy.savez_compressed", "os.replace"])
def test_a_full_disk_leaves_the_old_file(solution, tmp_path, monkeypatch, call):
    """One line that names the file; what was there stays, and nothing else does."""
    file = tmp_path / "kept.npz"
    solution.save(file)
    before = file.read_bytes()
    monkeypatch.setattr(call, no_space)
    with pytest.raises(mr.RadiosityError, match=re.escape(f"cannot write {file} (No space left on device)")):
        solution.save(file)
    assert os.listdir(tmp_path) == ["kept.npz"] and file.read_bytes() == before


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full here")
def test_a_device_that_is_really_full(solution, monkeypatch):
    """Bytes that do not fit are an error, not a short file."""
    import builtins

    def full(path, mode="r", *rest, **more):
        return real("/dev/full" if "w" in mode else path, mode, *rest, **more)

    real = builtins.open
    monkeypatch.setattr("mi_radiosity.solver.solution.open", full, raising=False)
    with pytest.raises(mr.RadiosityError, match="No space left"):
        solution.save("never.npz")
    assert not os.path.exists("never.npz")


@pytest.mark.parametrize("share", [0, 0.01, 0.3, 0.9, 0.999])
def test_truncated_solutions_are_refused(solution, cornell, tmp_path, share):
    file = tmp_path / "kept.npz"
    solution.save(file)
    whole = file.read_bytes()
    file.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(mr.RadiosityError, match="not a readable solution"):
        mr.Solution.load(file, cornell)


@pytest.mark.parametrize("byte", [0.2, 0.4, 0.6, 0.8])
def test_damaged_solutions_are_refused(solution, cornell, tmp_path, byte):
    """A flipped byte inside of an array does not pass for data."""
    file = tmp_path / "kept.npz"
    solution.save(file)
    data = bytearray(file.read_bytes())
    with zipfile.ZipFile(file) as archive:
        array = max(archive.infolist(), key=lambda member: member.compress_size)
    name, extra = (int.from_bytes(data[array.header_offset + k :][:2], "little") for k in (26, 28))
    data[array.header_offset + 30 + name + extra + int(byte * array.compress_size)] ^= 0xFF
    file.write_bytes(data)
    with pytest.raises(mr.RadiosityError, match="not a readable solution"):
        mr.Solution.load(file, cornell)


@pytest.mark.parametrize("missing", ["direct", "child", "sides", "stats"])
def test_incomplete_solutions_are_refused(solution, cornell, tmp_path, missing):
    """An archive of the right format without one of its arrays is damaged, too."""
    file = tmp_path / "kept.npz"
    solution.save(file)
    with np.load(file) as kept:
        arrays = {k: v for k, v in kept.items() if k != missing}
    np.savez(file, **arrays)
    with pytest.raises(mr.RadiosityError, match="not a readable solution"):
        mr.Solution.load(file, cornell)


@pytest.mark.parametrize("stage", ["refine", "distribute"])
def test_interrupted_solves_leave_nothing_behind(cornell, stage):
    """Ctrl-C comes out as KeyboardInterrupt, and the next solve is as if it had not been."""
    model = Model(cornell)
    clean = mr.solve(model, elements=1000, rays=50_000)

    def interrupt(now, done, total):
        if now == stage:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        mr.solve(model, elements=1000, rays=50_000, progress=interrupt)
    again = mr.solve(model, elements=1000, rays=50_000)
    np.testing.assert_array_equal(np.array(clean.radiosity()), np.array(again.radiosity()))


def test_an_interrupted_save_keeps_the_old_file(solution, tmp_path, monkeypatch):
    file = tmp_path / "kept.npz"
    solution.save(file)
    before = file.read_bytes()

    def interrupt(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr("numpy.savez_compressed", interrupt)
    with pytest.raises(KeyboardInterrupt):
        solution.save(file)
    assert os.listdir(tmp_path) == ["kept.npz"] and file.read_bytes() == before


CLI = [
    sys.executable,
    "-c",
    "import sys; from mi_radiosity.cli import main; print('ready', flush=True); sys.exit(main())",
]
BOX = "scenes_xml/cornell_box.xml"


@pytest.mark.parametrize("seconds", [0.2, 4.0])
def test_a_real_interrupt(tmp_path, seconds):
    """SIGINT while the scene loads, and rays are cast: status 130, one line, no traceback, nothing half-written."""
    run = subprocess.Popen(
        [*CLI, "render", BOX, "-o", str(tmp_path / "x.exr"), "--rays", "2000000000"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert run.stdout.readline() == "ready\n"
    time.sleep(seconds)
    run.send_signal(signal.SIGINT)
    _, said = run.communicate(timeout=120)
    assert (run.returncode, os.listdir(tmp_path)) == (130, []), said
    assert said.strip().count("\n") == 0 and "interrupted" in said


@pytest.fixture
def small_box(tmp_path):
    """The Cornell box as a scene file with a film of 32 × 32."""
    file = tmp_path / "box.xml"
    with open(BOX, encoding="utf-8") as box:
        text = (
            box.read()
            .replace('value="256"', 'value="32"')
            .replace('"meshes/', f'"{os.path.abspath("scenes_xml")}/meshes/')
        )
    file.write_text(text, encoding="utf-8")
    return file


def test_two_processes_on_one_reference(small_box, tmp_path):
    """Both end well, the file is whole and has the samples the greedier one asked for."""
    file = tmp_path / "ref.exr"
    runs = [
        subprocess.Popen(
            [*CLI, "reference", str(small_box), "-o", str(file), "--spp", str(spp)],
            stderr=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            text=True,
        )
        for spp in (512, 4096)
    ]
    for run in runs:
        _, said = run.communicate(timeout=300)
        assert run.returncode == 0, said
    reference = Reference.load(file)
    assert (
        reference.image().shape == (32, 32, 3)
        and sum(reference.spp) == 4096
        and sorted(os.listdir(tmp_path)) == ["box.xml", "ref.exr"]
    )


def test_work_of_another_process_is_not_undone(small_box, tmp_path):
    """A process that finds a reference further on than its own goes on from there."""
    file, ahead, seen = tmp_path / "ref.exr", tmp_path / "ahead.exr", []
    scene = mi.load_file(str(small_box))
    render_reference(scene, scene.sensors()[0], ahead, spp=512)

    def progress(done, total):
        seen.append(done)
        if done == 64:
            os.replace(ahead, file)

    found = render_reference(scene, scene.sensors()[0], file, spp=640, progress=progress)
    assert seen == [64, 128, 576, 640] and sum(found.spp) == sum(Reference.load(file).spp) == 640


def test_a_plugin_that_was_interrupted_solves_again(cornell):
    """No half-done solution is shown afterwards."""
    plugin = mi.load_dict({"type": "radiosity", "elements": 500, "rays": 20_000})

    def interrupt(*args):
        raise KeyboardInterrupt

    plugin.progress = interrupt
    with pytest.raises(KeyboardInterrupt):
        plugin.prepare(cornell)
    plugin.progress = None
    assert plugin.prepare(cornell).stats["rays"] == 20_000
