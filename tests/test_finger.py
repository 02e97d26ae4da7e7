"""One finger at rest: closed forms, fits of noisy data, and files; its material from a motion."""

import numpy as np
import pytest

from codesign_jax import cli, finger, scene
from codesign_jax.scene import parameters
from codesign_jax.scene.schema import InputError
from tests.helpers import beams


def made(links=10, **effects):
    loaded = scene.load("paper", overrides={"effects": effects, "discretization": {"links": links}})
    space = parameters.design_space(loaded.hand, "2d")
    design = space.from_units([110.0, 0.0])
    return finger.of_design(loaded, space.params(design), 0)


@pytest.mark.parametrize("links", [3, 10])
def test_closed_forms_of_beams(links):
    """M L / EI; M / L; 3 M / 2 L and P L^3 / 3 EI, both up to the chain's 1 - 1 / (4 N^2)."""
    mine, chain = made(links), 1 - 1 / (4 * links**2)
    [stiffness], [gain] = mine.stiffness, mine.gain
    moment, rigidity = 1e-3 * stiffness, stiffness * mine.segment  # 1e-3 rad a joint
    pressure = moment / gain
    load = 0.1 * moment / mine.length
    table = {n: np.array([pressure]) for n in ("pressure", *finger.MEASURED)}
    table["load"] = np.array([load])
    found = {n: v.item() for n, v in finger.predict(mine, table).items()}
    assert found["angle"] == pytest.approx(moment * mine.length / rigidity, rel=1e-9)
    assert found["blocked_force"] == pytest.approx(moment / mine.length, rel=1e-12)
    # At these loads geometric nonlinearity is of the square of the angles, 1e-4.
    assert found["tip_force"] == pytest.approx(1.5 * moment / mine.length / chain, rel=1e-3)
    expected = load * mine.length**3 / (3 * rigidity) * chain
    assert found["deflection"] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("alpha", [1, 2])
def test_a_large_load_gives_the_elastica(alpha):
    """Bisshopp and Drucker's tip; at 40 links the chain errs by 3e-4 at most."""
    mine = made(40)
    load = alpha * mine.stiffness[0] * mine.segment / mine.length**2
    rest = finger.Rest.of(mine, 0.0, load)
    assert -rest.height / mine.length == pytest.approx(beams.elastica(alpha)[0], rel=3e-4)


def synthetic(truth, noise, seed=0, columns=("angle", "tip_force")):
    """Rows that a finger would give, with noise relative to a column's root mean square."""
    table = {n: np.full(8, np.nan) for n in ("pressure", *columns)}
    table["pressure"] = np.linspace(5e3, 60e3, 8)
    if "deflection" in columns:
        table["load"] = np.full(8, 0.05)
    for name in columns:
        table[name][:] = 0.0
    table |= finger.predict(truth, table)
    random = np.random.default_rng(seed)
    for name in columns:
        size = np.sqrt((table[name] ** 2).mean())
        table[name] = table[name] + noise * size * random.standard_normal(8)
    return table


@pytest.mark.parametrize("columns", [("angle", "tip_force"), ("angle", "deflection")])
def test_a_fit_finds_the_material_within_its_own_error(columns):
    """Over ten draws of noise the errors are as large as it says; such a ratio varies by 22 %."""
    mine, truth = made(3), (52e3, 0.8)
    errors, spreads = [], []
    for seed in range(10):
        table = synthetic(mine.of_material(*truth), 0.02, seed, columns)
        found = finger.fit(mine, table)
        errors.append(np.log(np.divide(found[:2], truth)))
        spreads.append(found.spread)
    ratio = np.sqrt(np.mean(np.square(errors), 0) / np.mean(np.square(spreads), 0))
    assert (ratio > 0.4).all() and (ratio < 1.8).all()


def test_a_fit_under_the_neo_hookean_law_is_exact_without_noise():
    mine, truth = made(3, neo_hookean=True), (52e3, 0.8)
    found = finger.fit(mine, synthetic(mine.of_material(*truth), 0.0))
    np.testing.assert_allclose(found[:2], truth, rtol=1e-6)


def test_a_file_is_read_in_its_units(tmp_path):
    path = tmp_path / "finger.csv"
    path.write_text(
        "# mine\npressure_bar, angle_deg,load_mN,deflection_cm\n0.5,90,,\n\n1,,200,1.5\n"
    )
    table = finger.read(path)
    np.testing.assert_allclose(table["pressure"], [50e3, 100e3])
    np.testing.assert_allclose(table["angle"], [np.pi / 2, np.nan])
    np.testing.assert_allclose(table["load"], [np.nan, 0.2])
    np.testing.assert_allclose(table["deflection"], [np.nan, 0.015])


WRONG = {
    "presure_kPa,angle_deg\n1,2": "did you mean 'pressure_kPa'?",
    "pressure_kPa,pressure_Pa,angle_deg\n1,1,2": "column 'pressure' is given more than once",
    "# a\npressure_kPa,angle_deg\n\n1,x": "line 4, angle_deg = 'x' must be a number",
    "pressure_kPa,angle_deg\n-1,2": "a pressure is below 0",
    "pressure_kPa,load_N\n1,2": "no measured value; columns of them: angle, tip_force",
    "pressure_kPa,deflection_mm\n1,2": "a deflection has no load beside it",
    "# nothing": "is empty",
}


@pytest.mark.parametrize("text", WRONG)
def test_a_wrong_file_is_refused(text, tmp_path):
    path = tmp_path / "finger.csv"
    path.write_text(text)
    with pytest.raises(InputError, match="finger.csv") as error:
        finger.read(path)
    assert WRONG[text] in str(error.value)


def test_the_command_compares_and_fits(tmp_path, capsys):
    path, out = tmp_path / "finger.csv", tmp_path / "out.csv"
    truth = made().of_material(50e3)
    angles = np.rad2deg([finger.Rest.of(truth, p).angles.sum() for p in (20e3, 40e3)])
    path.write_text(f"pressure_kPa,angle_deg\n20,{angles[0]}\n40,{angles[1]}\n")
    line = ["finger", str(path), "--fit", "--design", "length=110", "--out", str(out)]
    assert cli.main(line) == 0
    said = capsys.readouterr().out
    assert "--set hand.material.shear_modulus=5e+04" in said and "110 mm long" in said
    assert "model: angle errs by" in said and "(25 %)" in said  # 50 / 40 - 1
    head, *rows = out.read_text().splitlines()
    assert head == "pressure_kPa,angle_deg,model_angle_deg,fitted_angle_deg" and len(rows) == 2
    for wrong in (["--fit"], ["--finger", "4"], ["--out", "table.txt"], ["no.csv"]):
        assert cli.main(["finger", *wrong]) == 2
    said = capsys.readouterr().err
    assert "--fit needs measurements" in said and "--finger = 4 is outside [0, 3]" in said
    assert "must end in .csv" in said and "no.csv: No such file" in said
