"""A gallery: a page of pictures beside `path`'s, and their figures."""

from types import SimpleNamespace

from mi_radiosity.cli import main
from mi_radiosity.evaluation import gallery

import mitsuba as mi
import numpy as np
import pytest

BOX = "scenes_xml/cornell_box.xml"


def test_gallery(tmp_path, capsys):
    """A page with a strip of three pictures and the figures of each scene; references are kept."""
    pytest.importorskip("matplotlib")
    arguments = ["gallery", BOX, "-o", str(tmp_path), "--work", str(tmp_path / "work")]
    assert main([*arguments, "--seconds", "0.5", "--reference-spp", "16"]) == 0
    page = (tmp_path / "gallery.md").read_text(encoding="utf-8")
    assert "cornell_box.xml" in page and "RMSE_a" in page and page.strip() in capsys.readouterr().out
    strip = np.array(mi.Bitmap(str(tmp_path / "gallery" / "cornell_box.jpg")))
    assert strip.shape[1] == 3 * strip.shape[0] and list((tmp_path / "work" / "references").glob("*.exr"))
    assert main(["gallery", "missing.xml", "-o", str(tmp_path)]) == 2
    assert "missing.xml" in capsys.readouterr().err


def test_scenes_of_one_name_are_told_apart():
    def titles(*paths):
        return gallery._titles([SimpleNamespace(path=path) for path in paths])

    assert titles("hall/scene.xml", "attic/lamp.xml") == ["scene.xml", "lamp.xml"]
    assert titles("hall/scene.xml", "attic/scene.xml") == ["hall/scene.xml", "attic/scene.xml"]
    assert titles("a/hall/scene.xml", "b/hall/scene.xml") == ["a/hall/scene.xml", "b/hall/scene.xml"]
