"""The same of what surveys hold: MEDS, HDF5, many exposures, samples; and of all catalogs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table
from damage import damaged, damaged_bytes, refused_or_done
from hypothesis import given, settings
from hypothesis import strategies as st

import fdnt_xp as fx
from fdnt_xp.data.exposures import Exposure, ExposureBatch
from fdnt_xp.errors import FdntError
from fdnt_xp.flags import FAILED
from images import galaxies, star

SIDE = 16
STAR = star((SIDE, SIDE))
GALAXIES = galaxies(np.array([[0.1, 0.2], [0.1, 0.2], [0.0, 0.1]]), (SIDE, SIDE), sigma=1.5)
ANY_NUMBERS = pytest.mark.filterwarnings(
    "ignore::RuntimeWarning", "ignore::fdnt_xp.errors.FdntWarning"
)

# --- arrays -------------------------------------------------------------------------------


def maybe(draw, name, array):
    """Return an option with a damaged array, or none."""
    return {name: draw(damaged(array))} if draw(st.booleans()) else {}


@st.composite
def exposures(draw):
    """Return arguments of `measure_exposures`."""
    options = {"object_index": draw(damaged(np.array([0, 0, 1])))}
    options |= maybe(draw, "origin", np.full((3, 2), 7.5))
    options |= maybe(draw, "jacobian", np.repeat([[[0.2, 0.01], [0.0, -0.2]]], 3, axis=0))
    options |= maybe(draw, "band", np.array([0, 1, 0]))
    name, noise = draw(
        st.sampled_from(
            [("noise_variance", np.full(3, 1e-6)), ("ivar", np.full(GALAXIES.shape, 1e6))]
        )
    )
    options |= maybe(draw, name, noise)
    options["transform"] = draw(st.sampled_from(["ft", "hybrid"]))
    return draw(damaged(STAR)), draw(damaged(GALAXIES)), options | {"order": 4}


@settings(max_examples=40)
@given(exposures())
@ANY_NUMBERS
def test_exposures_are_measured_or_refused(call):
    star_image, stamps, options = call
    try:
        result = fx.measure_exposures(stamps, fx.Psf.from_image(star_image), **options)
    except FdntError:
        return
    failed = (result.flags & int(FAILED)) != 0
    np.testing.assert_array_equal(np.isfinite(result.eta).all(axis=1), ~failed)
    assert np.isnan(result.eta_cov[failed]).all()
    assert len(result.stamp_flags) == len(stamps)


@st.composite
def samples(draw):
    """Return arguments of what measures the shear of a sample."""
    options = {}
    matrices = np.repeat([[[0.2, 0.01], [0.0, -0.2]]], 3, axis=0)
    options |= maybe(draw, "jacobian", matrices if draw(st.booleans()) else matrices[0])
    noise = draw(
        st.sampled_from(
            [
                None,
                ("noise_variance", np.full(3, 1e-6)),
                ("noise_power", np.full((SIDE, SIDE), 1e-6)),
            ]
        )
    )
    if noise is not None:
        options[noise[0]] = draw(damaged(noise[1]))
    return draw(damaged(STAR)), draw(damaged(GALAXIES)), options


@settings(max_examples=50)
@given(samples(), st.sampled_from([fx.population_null, fx.measure_responses, fx.shear_from_stack]))
@ANY_NUMBERS
def test_samples_are_measured_or_refused(call, measure):
    star_image, stamps, options = call
    if measure is fx.shear_from_stack:
        options = {name: value for name, value in options.items() if "noise" not in name}
    try:
        result = measure(stamps, fx.Psf.from_image(star_image), **options)
    except FdntError:
        return
    if measure is fx.measure_responses:
        assert np.isfinite(result.v[result.measured]).all()
        assert np.isnan(result.v[~result.measured]).all()
    else:
        assert np.isfinite(result.g).all()


@settings(max_examples=40)
@given(st.data())
@ANY_NUMBERS
def test_lists_of_exposures_are_measured_or_refused(data):
    try:
        lists = []
        for image in GALAXIES:
            given_ = {"image": data.draw(damaged(image)), "star": data.draw(damaged(STAR))}
            given_ |= maybe(data.draw, "ivar", np.full(image.shape, 1e6))
            given_ |= maybe(data.draw, "jacobian", np.eye(2))
            lists.append([Exposure(**given_)])
        result = fx.measure_exposures(**ExposureBatch.of(lists).arguments())
    except FdntError:
        return
    assert result.n_gal == len(GALAXIES)


# --- files --------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def meds(tmp_path_factory):
    """Return the bytes of a MEDS file."""
    files = pytest.importorskip("meds_files")  # which needs GalSim
    cutouts = files.drawn_cutouts()
    path = tmp_path_factory.mktemp("meds") / "tile.fits"
    return files.write_meds(path, files.objects_of(cutouts)).read_bytes()


@pytest.fixture(scope="module")
def hdf5(tmp_path_factory):
    """Return the bytes of an HDF5 file with stamps and a PSF."""
    h5py = pytest.importorskip("h5py")
    path = tmp_path_factory.mktemp("hdf5") / "tile.h5"
    with h5py.File(path, "w") as file:
        file["stamps"], file["psf"] = GALAXIES, STAR
    return path.read_bytes()


@settings(max_examples=25)
@given(data=st.data())
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_damaged_meds_files(data, folder, meds):
    Path("tile.fits").write_bytes(data.draw(damaged_bytes(meds)))
    options = data.draw(
        st.sampled_from([(), ("--cutouts", "epochs"), ("--segments", "ignore"), ("--chunk", "1")])
    )
    refused_or_done(["measure-exposures", "tile.fits", "-o", "out.fits", *options])
    Path("out.fits").unlink(missing_ok=True)


@settings(max_examples=25)
@given(data=st.data())
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_damaged_hdf5_files(data, folder, hdf5):
    Path("tile.h5").write_bytes(data.draw(damaged_bytes(hdf5)))
    image = data.draw(st.sampled_from(["tile.h5::stamps", "tile.h5", "tile.h5::psf"]))
    command = ["measure", image, "--psf", "tile.h5::psf", "--noise-variance", "1e-6"]
    refused_or_done([*command, "-o", "out.fits"])
    Path("out.fits").unlink(missing_ok=True)


@settings(max_examples=25)
@given(data=st.data())
def test_damaged_catalogs_of_rows(data, folder):
    pytest.importorskip("h5py")
    pytest.importorskip("pyarrow")
    name = Path(f"touched{data.draw(st.sampled_from(['.parquet', '.hdf5']))}")
    table = Table({"x": [1.0], "y": [2.0], "flags": [0], "e1": [0.1], "e2": [0.2]})
    options = {"path": "SHAPES", "serialize_meta": True} if name.suffix == ".hdf5" else {}
    table.write(name, overwrite=True, **options)
    name.write_bytes(data.draw(damaged_bytes(name.read_bytes())))
    refused_or_done(["shear", name], refused=True)
    name.unlink()
