"""The judge: metrics by hand and by the paper, references that resume, comparisons that survive."""

import json
import os
from pathlib import Path

import mi_radiosity as mr
from mi_radiosity.cli import main
from mi_radiosity.evaluation import metrics
from mi_radiosity.evaluation.bench import crossing
from mi_radiosity.evaluation.compare import Cell, InProcess, compare_oracles, run_cells
from mi_radiosity.evaluation.reference import Reference, path_image, render_reference
from mi_radiosity.evaluation.report import interval

import mitsuba as mi
import numpy as np
import pytest

BOX = "scenes_xml/box_furnace.xml"

# Table 1 and 2 of the paper: RMSE and the PSNR printed beside it.
PRINTED = [
    (10.872, 27.405),
    (10.173, 27.982),
    (9.998, 28.133),
    (9.232, 28.825),
    (9.555, 28.526),
    (8.786, 29.254),
    (9.370, 28.696),
    (8.568, 29.473),
    (13.046, 25.821),
    (11.903, 26.618),
    (11.279, 27.086),
    (10.438, 27.758),
    (9.709, 28.387),
    (10.010, 28.122),
    (9.257, 28.801),
    (9.548, 28.533),
    (8.740, 29.300),
    (15.530, 24.307),
    (14.145, 25.119),
    (13.844, 25.306),
    (13.683, 25.407),
    (14.679, 24.797),
    (13.573, 25.477),
]


# ---- Metrics ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("error, decibel", PRINTED)
def test_the_papers_own_numbers(error, decibel):
    assert metrics.psnr(error) == pytest.approx(decibel, abs=1.5e-3)


def test_errors_by_hand():
    """One pixel black, one white; the image gets red of the white one wrong by all of it."""
    reference = np.array([[[0, 0, 0], [1, 1, 1.0]]])
    image = np.array([[[0, 0, 0], [0, 1, 1.0]]])
    assert metrics.rmse(image, reference) == pytest.approx(255 * (1 / 6) ** 0.5)
    assert metrics.rmse(image, reference, metrics.PERCEPTUAL) == pytest.approx(255 * (0.2126 / 2) ** 0.5)
    assert metrics.relative_error(image, reference) == pytest.approx(1 / 1.01 / 6)
    assert metrics.srgb(np.array([0.2140411])) == pytest.approx(127.5, abs=1e-3)
    assert metrics.srgb(np.array([-1.0, 9.0])) == pytest.approx([0, 255])


def test_the_references_noise_is_removed():
    """True error 5 under noise 6 in each half: the clean RMSE is 5, within three of its standard errors."""

    def linear(y):
        return np.where(y <= 0.04045, y / 12.92, ((y + 0.055) / 1.055) ** 2.4)

    rng = np.random.default_rng(1)
    truth = np.full((200, 200, 3), 120.0)
    halves = linear((truth + rng.normal(0, 6, (2, 200, 200, 3))) / 255)
    errors = metrics.compare(linear((truth + 5) / 255), halves)
    assert errors.rmse_a == pytest.approx((25 + 18) ** 0.5, rel=0.01)
    assert abs(errors.rmse_a_clean - 5) < 3 * errors.rmse_a_clean_error < 1
    assert metrics.reference_noise(halves) == pytest.approx(18**0.5, rel=0.01)


def test_the_stated_uncertainty_is_right():
    """Over 200 references, noise shared by channels and neighbours, the clean error scatters as it says (χ², 99.9 %)."""
    from scipy.ndimage import uniform_filter
    from scipy.stats import chi2

    rng = np.random.default_rng(2)
    truth, scores = np.full((96, 96, 3), 0.3), []
    expected = metrics.rmse(truth * 1.05, truth)
    for _ in range(200):
        noise = uniform_filter(rng.normal(0, 0.02, (2, 96, 96, 1)), size=(1, 2, 2, 1))
        errors = metrics.compare(truth * 1.05, truth * (1 + noise))
        scores.append((errors.rmse_a_clean - expected) / errors.rmse_a_clean_error)
    low, high = chi2.ppf([0.0005, 0.9995], 200)
    assert low < np.sum(np.square(scores)) < high


def test_interval_is_students():
    mean, half = interval([1.0, 2.0, 3.0])
    assert (mean, half) == (2.0, pytest.approx(4.302653 / 3**0.5))


def test_crossing_of_curves():
    def points(*pairs):
        return [{"seconds": t, "rmse_a_clean": e} for t, e in pairs]

    result = crossing(points((1, 10), (10, 5)), points((1, 40), (100, 4)))
    assert result["seconds"] == pytest.approx(100 * (4 / 5) ** 2, rel=0.01)
    assert result["rmse_a"] == pytest.approx(5) and result["ours_seconds"] == pytest.approx(10)
    assert crossing(points((1, 10), (10, 5)), points((1, 40), (9, 20)))["seconds"] is None


# ---- References ------------------------------------------------------------------------------------


def box():
    scene = mi.load_file(BOX)
    return scene, scene.sensors()[0]


def test_reference_is_right_and_says_how_noisy_it_is(tmp_path):
    scene, sensor = box()
    reference = render_reference(scene, sensor, tmp_path / "ref.exr", spp=256)
    assert reference.image().mean() == pytest.approx(2 / np.pi, rel=0.01)
    again = Reference.load(tmp_path / "ref.exr")
    np.testing.assert_allclose(again.halves(), reference.halves(), rtol=1e-6)
    assert 0 < again.noise() < 2 and again.spp == [128, 128]


def test_reference_resumes_and_grows(tmp_path):
    scene, sensor = box()
    path, calls = tmp_path / "ref.exr", []

    def stop(done, total):
        calls.append(done)
        if done == 256:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_reference(scene, sensor, path, spp=512, progress=stop)
    assert sum(Reference.load(path).spp) == 128
    grown = render_reference(scene, sensor, path, spp=512, progress=lambda done, total: calls.append(done))
    straight = render_reference(scene, sensor, tmp_path / "other.exr", spp=512)
    assert calls == [64, 128, 192, 256, 192, 256, 320, 384, 448, 512]
    np.testing.assert_allclose(grown.halves(), straight.halves(), rtol=1e-4, atol=1e-5)
    assert grown.noise() < Reference.load(path).noise() * 1.01


def test_foreign_and_damaged_references(tmp_path, cornell):
    scene, sensor = box()
    path = tmp_path / "ref.exr"
    render_reference(scene, sensor, path, spp=1)
    with pytest.raises(mr.RadiosityError, match="another scene"):
        render_reference(cornell, cornell.sensors()[0], path, spp=1)
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(mr.RadiosityError, match="not a readable reference"):
        render_reference(scene, sensor, path, spp=1)


def test_path_is_unbiased_at_few_samples():
    """Four samples per pixel have the mean of many, whatever sampler the scene names."""
    scene = mi.load_file("scenes_xml/office.xml")
    few, many = (
        np.mean([path_image(scene, scene.sensors()[1], spp, seed).mean() for seed in range(2)]) for spp in (4, 25)
    )
    assert few == pytest.approx(many, rel=0.02)


def test_reference_command(tmp_path, capsys):
    assert main(["reference", BOX, "-o", str(tmp_path / "ref.exr"), "--spp", "64"]) == 0
    assert "its own RMSE_a is" in capsys.readouterr().out
    assert main(["reference", BOX, "-o", str(tmp_path / "ref.png")]) == 2


# ---- Comparisons -----------------------------------------------------------------------------------

QUICK = dict(oracles="ks,gmi:0.5", elements=200, rays=5000, seeds=2, spp=1, reference_spp=2)


def test_compare_writes_everything_and_resumes(tmp_path, monkeypatch, capsys):
    arguments = [
        "compare",
        BOX,
        "-o",
        str(tmp_path),
        "--oracles",
        "ks,gmi:0.5",
        "--elements",
        "200",
        "--rays",
        "300000",
        "--seeds",
        "2",
        "--spp",
        "1",
        "--reference-spp",
        "2",
    ]
    assert main(arguments) == 0
    results = json.loads((tmp_path / "results.json").read_text())
    assert {(r["question"], r["oracle"], r["seed"]) for r in results["rows"]} == {
        (q, o, s) for q in ("mesh", "rays", "time", "noise") for o in ("ks", "gmi") for s in (0, 1)
    }
    assert {
        "view",
        "oracle",
        "alpha",
        "seed",
        "elements",
        "pairs",
        "rays",
        "oracle_rays",
        "seconds",
        "rmse_a",
        "rmse_p",
        "psnr_a",
        "psnr_p",
    } <= set(results["rows"][0])
    table, page = (tmp_path / "table.md").read_text(), (tmp_path / "report.html").read_text()
    assert "RMSE_a (view 0)" in table and "**" in table
    assert (
        page.index("Its RMSE_a is") < page.index("<img")
        and "data:image/png;base64" in page
        and (tmp_path / "figure.png").exists()
    )
    same_rays = {
        r["oracle"]: r["rays"] + r["oracle_rays"] + r["pilot_rays"] for r in results["rows"] if r["question"] == "rays"
    }
    assert same_rays["ks"] == pytest.approx(same_rays["gmi"], rel=0.02)

    results["rows"] = [r for r in results["rows"] if r["key"] != "mesh gmi:0.5 1"]
    (tmp_path / "results.json").write_text(json.dumps(results))
    ran = []
    from mi_radiosity.evaluation import compare as module

    original = module.run_cells
    monkeypatch.setattr(
        module, "run_cells", lambda cells, *a, **k: ran.extend(c.key for c in cells) or original(cells, *a, **k)
    )
    assert main(arguments) == 0
    assert ran == ["mesh gmi:0.5 1"]
    assert main([*arguments[:-6], "--seeds", "2", "--spp", "2", "--reference-spp", "2"]) == 2
    assert "other settings" in capsys.readouterr().err


def test_refused_comparisons(tmp_path, capsys):
    assert main(["compare", BOX, "-o", str(tmp_path), "--oracles", "ks,delphi"]) == 2
    assert main(["compare", BOX, "-o", str(tmp_path), "--oracles", "gmi:x"]) == 2
    assert main(["compare", BOX, "-o", str(tmp_path), "--questions", "money"]) == 2
    assert "choose from" in capsys.readouterr().err
    (tmp_path / "results.json").write_text("{")
    with pytest.raises(mr.RadiosityError, match="damaged"):
        compare_oracles(BOX, tmp_path, **QUICK)


def cell(seed):
    return Cell(BOX, "llvm_ad_rgb", (), "ks", seed, 200, 1000, 10, 1, (0,), ("none.exr",))


def test_a_failing_cell_gets_one_more_try():
    tries, finished = [], []

    def work(c):
        tries.append(c.seed)
        if (c.seed == 1 and tries.count(1) == 1) or c.seed == 2:
            raise OSError("gone")
        return c.seed

    failed = run_cells([cell(s) for s in range(4)], InProcess(), lambda c, r: finished.append(r), work=work)
    assert sorted(finished) == [0, 1, 3] and [c.seed for c in failed] == [2]
    assert tries.count(0) == 1 and tries.count(1) == tries.count(2) == 2


def _die_once(c):
    mark = Path(os.environ["MARK"]) if "MARK" in os.environ else Path(c.references[0])
    if c.seed == 1 and not mark.exists():
        mark.touch()
        os._exit(1)
    return c.seed


def test_on_a_dask_cluster(tmp_path):
    """A real local cluster of two workers gives the rows of the process itself; a dead worker costs no row."""
    distributed = pytest.importorskip("distributed")
    from mi_radiosity.evaluation.compare import executor_for

    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        here = compare_oracles(BOX, tmp_path / "here", **QUICK, questions=("mesh",))
        there = compare_oracles(
            BOX, tmp_path / "there", **QUICK, questions=("mesh",), scheduler=cluster.scheduler_address
        )

        def errors(results):
            return {r["key"]: r["rmse_a"] for r in results["rows"]}

        # Each has a reference of its own, of two samples: only the pictures are to the bit.
        assert errors(here).keys() == errors(there).keys()
        for name in (tmp_path / "here" / "images").iterdir():
            other = np.array(mi.Bitmap(str(tmp_path / "there" / "images" / name.name)))
            np.testing.assert_allclose(np.array(mi.Bitmap(str(name))), other, rtol=1e-4, atol=1e-4)

        finished = []
        cells = [
            Cell(BOX, "llvm_ad_rgb", (), "ks", s, 200, 1000, 10, 1, (0,), (str(tmp_path / "mark"),)) for s in range(4)
        ]
        executor = executor_for(cluster.scheduler_address)
        assert run_cells(cells, executor, lambda c, r: finished.append(r), work=_die_once) == {}
        assert sorted(finished) == [0, 1, 2, 3]


def test_no_scheduler(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    with pytest.raises(mr.RadiosityError, match="no Dask scheduler"):
        from mi_radiosity.evaluation import compare as module

        module.executor_for("tcp://127.0.0.1:9")


def test_bench_command(tmp_path, capsys):
    assert (
        main(
            [
                "bench",
                BOX,
                "-o",
                str(tmp_path),
                "--elements",
                "200",
                "--rays",
                "20000",
                "--reference-spp",
                "16",
                "--path-spp",
                "4",
                "--views",
                "2",
            ]
        )
        == 0
    )
    results = json.loads((tmp_path / "bench.json").read_text())
    assert (
        results["tracing"]["solve_over_tracing"] > 0
        and len(results["one"]["ours"]) == 7
        and [p["spp"] for p in results["one"]["path"]] == [1, 4]
    )
    assert (tmp_path / "error_time.png").exists() and "path" in capsys.readouterr().out
