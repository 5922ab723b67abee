"""Files of view factors."""

import csv
import json
import os
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np

from ..core.errors import RadiosityError
from ..core.extras import optional
from ..core.files import check_side_file, check_writable, writing
from ..transport import Closure, ViewFactors

SUFFIXES = (".npz", ".csv", ".mtx")
FACETS = ("number", "name", "area")  # columns of the table of facets
LINES = 1 << 18  # of a table written at a time


def check_factors_path(path: str | os.PathLike[str]) -> None:
    """Raise RadiosityError now if view factors could not be written to ``path``, or if the table beside that would
    overwrite another file."""
    if Path(path).suffix.lower() not in SUFFIXES:
        raise RadiosityError(f"{path}: choose a name that ends in .npz, .csv or .mtx")
    check_writable(path)
    if Path(path).suffix.lower() != ".npz":
        check_side_file(facets_path(path), ",".join(FACETS).encode(), Path(path))


def facets_path(path: str | os.PathLike[str]) -> Path:
    """Where the names and areas that belong to a .csv or .mtx file are: NAME_facets.csv."""
    return Path(path).with_name(f"{Path(path).stem}_facets.csv")


def write_factors(
    factors: ViewFactors, path: str | os.PathLike[str], progress: Callable[[int, int], None] = lambda done, total: None
) -> None:
    """Write view factors by the suffix of ``path``; no file is left half-written.

    .npz: what scipy.sparse.load_npz reads, and `read_factors` with ``error``, ``names``, ``areas`` and ``closure``.
    .csv: a line i, j, F, error per entry, counted from 0. .mtx: what scipy.io.mmread reads, counted from 1. Beside the
    latter two, NAME_facets.csv has number, name and area (m²) of the facets, and the further columns without an area.
    """
    check_factors_path(path)
    suffix = Path(path).suffix.lower()
    with writing(path) as temporary:
        {".npz": _write_npz, ".csv": _write_csv, ".mtx": _write_mtx}[suffix](factors, temporary, progress)
    if suffix != ".npz":
        with writing(facets_path(path)) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
            table = csv.writer(file)
            table.writerow(FACETS)
            areas = [*map(float, factors.areas), *[""] * (len(factors.names) - len(factors.areas))]
            table.writerows(zip(range(len(factors.names)), factors.names, areas))


def read_factors(path: str | os.PathLike[str]) -> ViewFactors:
    """Read what `write_factors` has written as .npz. Raises RadiosityError if the file holds no view factors."""
    sparse = optional("scipy.sparse", "a matrix of view factors", "factors")
    try:
        with np.load(path) as data:
            F, error = (
                sparse.csr_array((data[name], data["indices"], data["indptr"]), shape=tuple(data["shape"]))
                for name in ("data", "error")
            )
            names = tuple(map(str, data["names"]))
            closure, stats = (json.loads(str(data[name])) for name in ("closure", "stats"))
            return ViewFactors(F, error, names, data["areas"], Closure(**closure), stats)
    except FileNotFoundError:
        raise RadiosityError(f"{path} does not exist: write view factors first") from None
    except Exception as error:
        raise RadiosityError(f"{path} holds no view factors ({type(error).__name__}): compute them again") from None


def _write_npz(factors, path, progress):
    F = factors.F
    with open(path, "wb") as file:
        np.savez(
            file,
            **{"format": b"csr", "shape": F.shape, "data": F.data, "indices": F.indices, "indptr": F.indptr},
            _is_array=True,
            error=factors.error.data,
            names=np.array(factors.names),
            areas=factors.areas,
            closure=json.dumps(asdict(factors.closure)),
            stats=json.dumps(factors.stats),
        )


def _write_csv(factors, path, progress):
    F, error = factors.F.tocoo(), factors.error.data
    with open(path, "w", encoding="utf-8") as file:
        file.write("i,j,F,error\n")
        for start in range(0, F.nnz, LINES):
            part = slice(start, start + LINES)
            rows = zip(*(x[part].tolist() for x in (*F.coords, F.data, error)))
            file.writelines(f"{i},{j},{value:.9g},{spread:.3g}\n" for i, j, value, spread in rows)
            progress(min(start + LINES, F.nnz), F.nnz)


def _write_mtx(factors, path, progress):
    comment = "view factors; numbers, names and areas of the facets are in the table beside this file"
    with open(path, "wb") as file:
        optional("scipy.io", "a matrix of view factors", "factors").mmwrite(
            file, factors.F, comment=comment, field="real", symmetry="general"
        )
