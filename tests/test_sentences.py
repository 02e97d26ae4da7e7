"""What is said of bad input, word by word: one golden file, data/sentences.txt.

    python -m tests.test_sentences     # writes it, after a change of words

Other tests assert kind and key of a problem (helpers/refusals.py), so that words may change here.
"""

import contextlib
import pickle
import shlex
import tempfile
from pathlib import Path

from codesign_jax import cli, finger, parameters, scene
from codesign_jax.engines import make_engine
from codesign_jax.scene import InputError, hand, keypaths, schema, silicones, sums

GOLDEN = Path(__file__).parent / "data" / "sentences.txt"
OVERRIDES = (
    "gravity=-1",
    "gravity=three",
    "gravty=3",
    "discretization.links=10.0",
    "hand.section.width=18",
    "hand.palm.mass=250",
    "hand.material=5",
    "hand.material=dragonskin",
    "hand.material.law=mooney_rivlin",
    "hand.material.shear_modulus=60e3",
    "hand.finger.0.base=[37, 0]",
    "hand.finger.0.bse=1",
    "hand.finger.9.tilt=1",
    "hand.section.tapered=true",
    "hand.preset.2d.fixed.pressure=[120, 110]",
    "hand.preset.2d.fixed.wall=2.5",
    "objects.object.spher.mass=1",
    "objects.object.sphere.size=[0.03, 0.04]",
    "objects.object.sphere.density=1000",
    "phases.lift=3.0",
    "phases.disturb=8.8",
    "cost.failure=ignore",
    "control.frame.1.time=approach - 9",
    "control.frame.1.z=arm_w",
    "control.frame.1.z=pressure",
)
OF_ELEMENTS = {
    "hand.section.law": "elements",
    "effects.lateral_threshold": True,
    "effects.air_mass": True,
    "effects.section_growth": True,
}
SUMS = ("2 * (arm_z)", "arm_z -", "arm_z - 0,01", "30°", "150 kPa", "1e3 * arm_z", "95")
CALLS = {
    "a file that there is not": lambda: hand.load("nowhere/hand.toml"),
    "a misspelt hand": lambda: hand.load("pneuflex"),
    "a misspelt silicone": lambda: silicones.get("ecoflex"),
    "a pair without a value": lambda: keypaths.parse(["gravity"]),
    "a misspelt engine": lambda: make_engine("mujocco", scene.load("paper")),
    "a name for a scene": lambda: make_engine("mujoco", "paper"),  # type: ignore[arg-type]
    "effects that a section's law has": lambda: scene.load("paper", overrides=OF_ELEMENTS),
    "a misspelt preset": lambda: parameters.design_space(scene.load("paper").hand, "24d"),
    "a field with control characters": lambda: scene.load("paper\x1b[2J"),
}
COMMANDS = (
    "compare",
    "compare nowhere",
    "compare a.toml",
    "compare a.toml b.toml --out a.csv",
    "compare a.toml b.toml --policy a:B c:D",
    "evaluate --particle 0",
    "evaluate --out trials.txt",
    "evaluate --engine mujocco",
    "evaluate --dry-run --policy mine.py:Pull",
    "evaluate --dry-run --preset 23d --design length=95 length[1]=90 lenght=80 arm_z=high",
    "evaluate --dry-run --set solver.iterations=31",
    "render --trial 0",
    "render --object spheer",
    "render --out a.mp4 --times 0",
    "render --camera frnt",
    "render --camera side zoom=2",
    "render --size 5000",
    "landscape --parameters length arm_q",
    "landscape --parameters gravity length",
    "landscape --parameters gravity=9:3 length",
    "landscape --parameters gravity=3:900 length",
    "finger --fit",
    "finger nowhere.csv",
    "export --out parts --tolerances wal=0.5 mount=x length=-1",
    "optimize --optimizer mine",
    "optimize --schedule switch-2 --episodes 1",
    "optimize --optimizer cma-es --particles 1",
    "optimize --seeds 0-",
    "optimize --seeds 0-1 --seed 1",
    "optimize --hand pneuflex5 --engine mujco --seed -1 --set gravity=1000 cost.failur=worst",
    "evaluate --run nowhere --hand tripod3 --preset 23d",
    "evaluate --design length=0.148",
    "evaluate --pull 1,2",
    "landscape --search 3",
    "check --accuracy reference",
)
MEASUREMENTS = (
    "pressure_kPa,angle_deg\n20,18,9",
    "pressure_Pa\tangle_deg\n20,000\t18.9",
    "pressure_Pa\tangle_deg\n20,000\t19\n40,000\t37",
    'pressure_Pa,angle_deg\n"20,000",18.9',
    "version https://git-lfs.github.com/spec/v1\noid",
    "pressure_kPa angle_deg\n20 18.9",
    "Druck (mbar);angle_deg\n1;2",
    "presure_kPa,angle_deg\n1,2",
    "pressure_kPa,load_N\n1,2",
    "pressure_kPa,deflection_mm\n1,2",
    'pressure_kPa,angle_deg\n"1,2\n3,4\n',
)
"""Files of measurements."""


def measured(text: str):
    """Reads a file of measurements with this text."""
    Path("finger.csv").write_text(text, encoding="utf-8")
    return finger.read(Path("finger.csv"))


def told(call) -> list[str]:
    """The sentences of what a call refuses."""
    try:
        call()
    except InputError as error:
        return [f"[{problem.code}] {problem}" for problem in error.problems]
    return []


def sentences() -> str:
    """All cases, each with what is said."""
    said = {}
    for pair in OVERRIDES:
        changes = keypaths.parse([pair])
        said[pair] = told(lambda changes=changes: scene.load("paper", overrides=changes))
    said |= {f"the sum {text}": [str(sums.read(text, "m"))] for text in SUMS}
    said |= {name: told(call) for name, call in CALLS.items()}
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for line in COMMANDS:
            said[f"codesign {line}"] = told(lambda line=line: cli.run(shlex.split(line)))
        for text in MEASUREMENTS:
            said[f"the file {text!r}"] = told(lambda text=text: measured(text))
    assert all(said.values()), [name for name, lines in said.items() if not lines]
    blocks = ["\n".join([name, *(f"    {line}" for line in lines)]) for name, lines in said.items()]
    return "\n".join(blocks) + "\n"


def test_sentences_are_those_of_the_golden_file():
    again = "python -m tests.test_sentences"
    assert sentences() == GOLDEN.read_text(encoding="utf-8"), again


def test_what_a_problem_is_about_begins_its_sentence():
    cases = {
        "gravity = -1 is outside [0, 100]": "gravity",
        "hand.finger[0].bse is not a known key": "hand.finger[0].bse",
        "hands.toml.preset 2d.fixed.pressure = [1] must be": "hands.toml.preset 2d.fixed.pressure",
        "object a: open.off: not watertight": "object a",
        "params have no axis (world,)": "params",
        "its surface does not close": "",
    }
    for sentence, key in cases.items():
        assert schema.Problem("invalid", sentence).key == key


def test_an_error_keeps_its_kinds_in_another_process():
    error = InputError.of("range", "gravity = -1 is outside [0, 100]")
    [problem] = pickle.loads(pickle.dumps(error)).problems
    assert (problem.code, problem.key) == ("range", "gravity") and problem == error.problems[0]


if __name__ == "__main__":
    GOLDEN.write_text(sentences(), encoding="utf-8")
