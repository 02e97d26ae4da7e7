"""Objects and primitives against MuJoCo C, trimesh and closed forms: pose, mass, distance."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from codesign_jax import preflight, scene
from codesign_jax.engines.mujoco import world_model
from codesign_jax.engines.structured.lanes import apply_columns
from codesign_jax.engines.structured.laws import rings, shapes
from codesign_jax.scene import objects, primitives, rigid_bodies, scene_files, schema
from tests.helpers import grasps
from tests.helpers.solids import box, object_file

COMMON = "friction = 0.8; mass = 0.1"
MESH = f'name = "a"; type = "mesh"; file = "a.stl"; unit = "mm"; {COMMON}'
BOX = f'name = "a"; type = "box"; size = [0.02, 0.02, 0.06]; {COMMON}'
SHAPES = {
    "box": BOX,
    "cylinder": f'name = "a"; type = "cylinder"; size = [0.02, 0.05]; {COMMON}',
    "capsule": f'name = "a"; type = "capsule"; size = [0.02, 0.03]; {COMMON}',
    "sphere": f'name = "a"; type = "sphere"; size = [0.03]; {COMMON}',
}


def only(tmp_path, entry, mesh=None):
    """The object of a set of one."""
    if mesh is not None:
        mesh.export(tmp_path / "a.stl")
    return objects.load(object_file(tmp_path, entry)).object[0]


def tilted(degrees, *sizes):
    mesh = box(*(sizes or (40, 40, 120)))
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.radians(degrees), [1, 0, 0]))
    return mesh


def test_angles_turn_as_mujocos():
    """Its eulerseq XYZ: about the axes of the world, x first."""
    text = """<mujoco><compiler eulerseq="XYZ"/><worldbody><body euler="20 -35 70">
      <geom size="1"/></body></worldbody></mujoco>"""
    theirs = mujoco.MjModel.from_xml_string(text).body_quat[1]
    np.testing.assert_allclose(rigid_bodies.turned((20, -35, 70), (1, 0, 0, 0)), theirs, atol=1e-15)
    np.testing.assert_allclose(rigid_bodies.turned(theirs, (1, 0, 0, 0)), theirs, atol=1e-15)


@pytest.mark.parametrize(
    "kind",
    [pytest.param(k, marks=[pytest.mark.slow] * (k in ("capsule", "sphere"))) for k in SHAPES],
)
def test_an_object_touches_the_table_however_it_is_turned(tmp_path, kind):
    """By MuJoCo's own distance at the start of trials with noise about all axes."""
    path = object_file(tmp_path, SHAPES[kind] + "; orientation = [50, 20, 10]")
    the_scene = scene.load("paper_spheres", object_set=path, overrides={"effects": EMPTY})
    trial = grasps.still()._replace(yaw=np.array(0.7), size=np.array(1.04))
    for tilt in (None, np.array([0.4, -1.9])):
        with jax.enable_x64(True):
            params, _ = grasps.hand_world(the_scene)
            fields, _ = grasps.world_inputs(the_scene, params, trial._replace(tilt=tilt))
        compiled = world_model(the_scene, fields)
        data = mujoco.MjData(compiled)
        data.qpos[:] = fields.start
        mujoco.mj_kinematics(compiled, data)
        pair = (compiled.geom(name).id for name in ("table", "object_0"))
        # Its iteration for round bodies ends at 1e-6.
        assert mujoco.mj_geomDistance(compiled, data, *pair, 1.0, None) == pytest.approx(
            0, abs=1e-6
        )


EMPTY = dict.fromkeys(("finger_table", "finger_object", "palm_table", "palm_object"), False)


def test_a_tilted_box_rests_by_its_stable_poses(tmp_path):
    """Of 40 x 50 x 120 mm: by trimesh's probabilities, and turned no more than it takes."""
    mesh = tilted(35, 40, 50, 120)
    turns, chances = trimesh.poses.compute_stable_poses(mesh, seed=0)
    sides: dict[int, float] = {}
    for matrix, chance in zip(turns, chances, strict=True):
        height = round(trimesh.transform_points(mesh.vertices, matrix)[:, 2].mean())
        sides[height] = sides.get(height, 0.0) + chance
    assert [*sides] == [20, 25, 60]
    resting = only(tmp_path, MESH, mesh).resting()
    np.testing.assert_allclose([p.probability for p in resting], [*sides.values()], atol=1e-6)
    for k, (height, angle) in enumerate(zip(sides, (None, 55, 35), strict=True), 1):
        shape = only(tmp_path, f'{MESH}; pose = "stable:{k}"')
        assert shape.rest_height(rigid_bodies.up(shape.upright)) == pytest.approx(
            1e-3 * height, rel=1e-6
        )
        assert shape.height == pytest.approx(2e-3 * height, rel=1e-6)
        assert shape.fall == (0, 0.0)
        if angle:  # about x, along which the box was turned in its file
            back = Rotation.from_quat(np.roll(shape.orientation, -1)).as_rotvec(degrees=True)
            np.testing.assert_allclose(np.abs(back), [angle, 0, 0], atol=1e-4)


def test_a_pose_is_kept_as_an_orientation(tmp_path):
    """So that the files of a run read as the same object with any trimesh."""
    mesh = tilted(35)
    path = object_file(tmp_path, f'{MESH}; pose = "stable"')
    mesh.export(tmp_path / "a.stl")
    the_scene = scene.load("paper_spheres", object_set=path)
    scene_files.write_scene(the_scene, tmp_path / "run")  # reads it back and compares
    text = (tmp_path / "run" / "objects.toml").read_text()
    assert "pose" not in text and "orientation" in text
    first, second = (only(tmp_path, f'{MESH}; pose = "{p}"') for p in ("stable", "stable:1"))
    assert first == second == the_scene.objects.object[0]


@pytest.mark.parametrize("kind", SHAPES)
def test_primitives_rest_by_mujoco(tmp_path, kind):
    """Put down in its most probable pose, a shape has not turned after two seconds."""
    shape = only(tmp_path, SHAPES[kind] + '; pose = "stable"')
    data = put_down(shape)
    np.testing.assert_allclose(np.abs(data.qpos[3:] @ shape.upright), 1, atol=1e-9)
    assert shape.fall[1] < 1e-6


@pytest.mark.parametrize("degrees", [10, 35, 80])
def test_what_topples_is_said_before_a_run(tmp_path, degrees):
    """A box on an edge falls as in MuJoCo C: back onto its end, or onto its side."""
    shape = only(tmp_path, f"{BOX}; orientation = [{degrees}, 0, 0]")
    up = np.zeros(9)
    mujoco.mju_quat2Mat(up, put_down(shape).qpos[3:])
    angle = np.degrees(np.arccos(np.clip(up[8], 0, 1)))
    assert shape.fall[0] == pytest.approx(abs(angle - degrees), abs=1)
    the_scene = scene.load("paper_spheres", object_set=tmp_path / "objects.toml")
    [line] = [text for text in preflight._scene_warnings(the_scene) if "topples" in text]
    assert f"topples by {shape.fall[0]} degrees" in line and 'pose = "stable"' in line


def put_down(shape):
    """MuJoCo's own model of a primitive two seconds after it was put on a plane."""
    quat, size = (" ".join(map(str, v)) for v in (shape.upright, shape.half_sizes))
    height = shape.rest_height(rigid_bodies.up(shape.upright))
    text = f"""<mujoco><worldbody><geom type="plane" size="1 1 1"/>
      <body pos="0 0 {height}" quat="{quat}"><freejoint/>
      <geom type="{shape.type}" size="{size}" mass="0.1"/></body></worldbody></mujoco>"""
    compiled = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(compiled)
    mujoco.mj_step(compiled, data, 1000)
    return data


def test_what_rests_does_not_topple(tmp_path):
    """On a face, on the rim of a tube, on a point below the centre, and on an edge of many."""
    make = trimesh.creation
    lying = make.cylinder(30, 80, sections=32)
    lying.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
    for mesh in (box(40, 40, 60), make.annulus(20, 30, 50), make.icosphere(3, 30), lying):
        angle, sunk = only(tmp_path, MESH, mesh).fall
        assert angle <= preflight.FALL or sunk < preflight.ROLL


def test_a_tilt_of_the_noise_asks_for_settling():
    """Without it objects fall while the hand comes; it costs nothing, and the phases move."""
    changes = {"objects.noise.tilt": 30.0}
    plain = scene.load("paper_spheres", overrides=changes)
    settled = scene.load("paper_spheres", overrides=changes | {"phases.settle": 0.5})
    warned = [
        any("phases.settle" in t for t in preflight._scene_warnings(s)) for s in (plain, settled)
    ]
    assert warned == [True, False]
    np.testing.assert_allclose(np.subtract(settled.window, plain.window), 0.5)
    assert settled.num_steps == plain.num_steps + 50
    params, trial = grasps.hand_world(plain)
    (_, early), (_, late) = (grasps.world_inputs(s, params, trial) for s in (plain, settled))
    np.testing.assert_allclose(late[:50], np.broadcast_to(early[0], (50, early.shape[1])))
    np.testing.assert_allclose(late[50:], early, atol=2e-6)  # float32 of times that are 0.5 s later


def lead_and_wood(place=""):
    """MuJoCo's composite of two boxes, heavy below; `place`: where its body is."""
    text = f"""<mujoco><worldbody><body {place}><freejoint/>
      <geom type="box" size="0.02 0.02 0.03" pos="0 0 -0.03" mass="0.3"/>
      <geom type="box" size="0.02 0.02 0.03" pos="0 0 0.03" mass="0.05"/></body>
    </worldbody></mujoco>"""
    return mujoco.MjModel.from_xml_string(text)


def test_a_mesh_has_the_mass_centre_and_inertia_of_its_file(tmp_path):
    """A box of lead and wood in a frame of its own."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.3, 0.9, -0.5]).as_matrix()
    pose[:3, 3] = [10, -20, 5]
    mesh = box(40, 40, 120)
    mesh.apply_transform(pose)
    quat = " ".join(map(str, np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1)))
    compiled = lead_and_wood(f'pos="0.01 -0.02 0.005" quat="{quat}"')
    data = mujoco.MjData(compiled)
    mujoco.mj_forward(compiled, data)
    axes = data.ximat[1].reshape(3, 3)
    full = axes @ np.diag(compiled.body_inertia[1]) @ axes.T
    six = [float(full[i, j]) for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    entry = MESH.replace("mass = 0.1", "mass = 0.35")
    entry += f"; centre_of_mass = {data.xipos[1].tolist()}; inertia = {six}"
    shape = only(tmp_path, entry, mesh)
    np.testing.assert_allclose(
        0.35 * np.sort(shape.unit_inertia), np.sort(compiled.body_inertia[1]), rtol=1e-6
    )
    frame = Rotation.from_quat(np.roll(shape.mesh.upright, -1)).as_matrix()
    inertia = 0.35 * frame @ np.diag(shape.unit_inertia) @ frame.T
    np.testing.assert_allclose(inertia, full, atol=1e-6 * full.max())
    # STL has float32: 4e-9 m of 60 mm.
    back = shape.mesh.vertices @ frame.T + data.xipos[1]
    np.testing.assert_allclose(np.sort(back, 0), np.sort(1e-3 * mesh.vertices, 0), atol=1e-8)
    assert only(tmp_path, MESH).mesh.digest != shape.mesh.digest  # grids are in other frames
    # Its ends are two poses, as it stands more often on the heavy one.
    assert len(shape.resting()) == 3 and len(only(tmp_path, MESH).resting()) == 2


def test_a_primitive_may_have_its_centre_of_mass_elsewhere(tmp_path):
    """The same as a primitive: MuJoCo's inertia, and the closed form of how high it stands."""
    compiled = lead_and_wood()
    along, *_, across = np.sort(compiled.body_inertia[1])
    low = float(compiled.body_ipos[1, 2])
    entry = BOX.replace("mass = 0.1", "mass = 0.35") + f"; centre_of_mass = [0, 0, {low}]"
    shape = only(tmp_path, f"{entry}; inertia = [{across}, {across}, {along}]")
    expected = np.sort(compiled.body_inertia[1])
    np.testing.assert_allclose(0.35 * np.sort(shape.unit_inertia), expected, rtol=1e-9)
    # STL has float32: 4e-9 m of 60 mm.
    assert shape.rest_height(rigid_bodies.up(shape.upright)) == pytest.approx(0.06 + low, abs=1e-8)
    assert shape.radius == pytest.approx(np.linalg.norm([0.02, 0.02, 0.06 - low]), abs=1e-8)
    assert len(shape.resting()) == 3  # its ends are two
    kept = scene.load("paper_spheres", object_set=tmp_path / "objects.toml")
    scene_files.write_scene(kept, tmp_path / "run")  # reads it back and compares
    lying = only(tmp_path, SHAPES["capsule"] + "; centre_of_mass = [0, 0, 0.01]")
    assert lying.rest_height(rigid_bodies.up(lying.upright)) == pytest.approx(
        0.02, rel=2e-3
    )  # facets


def test_mass_of_primitives_by_density(tmp_path):
    for kind, entry in SHAPES.items():
        shape = only(tmp_path, entry.replace("mass = 0.1", "density = 800"))
        size = " ".join(map(str, shape.half_sizes))
        text = f"""<mujoco><worldbody><body><freejoint/>
          <geom type="{kind}" size="{size}" density="800"/></body></worldbody></mujoco>"""
        assert shape.mass == pytest.approx(mujoco.MjModel.from_xml_string(text).body_mass[1])
        assert shape.density is None


@pytest.mark.parametrize(
    ("entry", "expected"),
    [
        (BOX + "; inertia = [1e-4, 1e-4, 3e-4]", "is of no body: its principal moments are 0.0001"),
        (BOX + "; inertia = [1e-2, 1e-2, 1e-2]", "reaches 66.3 mm .* more than 0.00044 kg m"),
        (BOX + "; inertia = [1e-4, 1e-4, 1e-4, 1e-5, 0, 0]", "inertia of a box is xx, yy and zz"),
        (BOX + "; density = 100", "a box has either a mass or a density"),
        (BOX + "; centre_of_mass = [0, 0, 0.07]", "a: box.stl: centre_of_mass at 0, 0, 70 mm"),
        (MESH + "; centre_of_mass = [0, 0]", "centre_of_mass must have three coordinates"),
        (
            MESH + "; inertia = [1e-4, 1e-4, 1e-4, 9e-5, 9e-5, -9e-5]",
            "must be positive about every",
        ),
        (BOX + '; pose = "stable:3"', r"asks for pose 3: it has 2 stable poses, 1 \(\d+ %\), 2"),
        (BOX + '; pose = "stable"; orientation = [0, 0, 0]', "give either orientation or pose"),
        (BOX + "; orientation = [1, 1, 0, 0]", "must be a unit quaternion w, x, y, z: its norm is"),
    ],
)
def test_impossible_bodies_are_refused(tmp_path, entry, expected):
    with pytest.raises(schema.InputError, match=expected):
        only(tmp_path, entry, box(40, 40, 120))


# --- the record of each primitive against MuJoCo --------------------------------------------------


# No two sizes of a shape are equal, so that none can stand for another.
SIZES = {
    "box": (0.030, 0.022, 0.041),
    "cylinder": (0.030, 0.036, 0.0),
    "capsule": (0.024, 0.020, 0.0),
    "sphere": (0.030, 0.0, 0.0),
}
KINDS = list(primitives.PRIMITIVES)


def on_table(kind):
    """MuJoCo's own model of a shape of 1 kg on a plane, in the record's start orientation."""
    shape = primitives.PRIMITIVES[kind]
    size = SIZES[kind]
    quat = " ".join(map(str, shape.upright))
    text = f"""<mujoco><worldbody><geom type="plane" size="1 1 1"/>
      <body pos="0 0 {shape.reach(size, rigid_bodies.up(shape.upright))}" quat="{quat}"><freejoint/>
      <geom type="{kind}" size="{" ".join(map(str, size))}" mass="1"/></body>
    </worldbody></mujoco>"""
    return mujoco.MjModel.from_xml_string(text)


@pytest.mark.parametrize("kind", KINDS)
def test_inertia_and_bounds_are_those_of_mujocos_compiler(kind):
    compiled = on_table(kind)
    shape = primitives.PRIMITIVES[kind]
    size = SIZES[kind]
    # MuJoCo sorts principal moments by turning the frame; the set of them stays.
    np.testing.assert_allclose(
        np.sort(shape.inertia(size)), np.sort(compiled.body_inertia[1]), rtol=1e-12
    )
    assert shape.radius(size) == pytest.approx(compiled.geom_rbound[1], rel=1e-12)
    np.testing.assert_allclose(shape.half_extents(size), compiled.geom_aabb[1, 3:], rtol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_triangles_lie_on_the_surface_and_have_its_inertia(kind):
    """In the shape's own axes, with its volume; polyhedra in round shapes lack up to 0.5 %."""
    shape = primitives.PRIMITIVES[kind]
    size = SIZES[kind]
    mesh = shape.triangles(size)
    inertia = np.diag(mesh.moment_inertia) / mesh.volume
    np.testing.assert_allclose(shape.inertia(size), inertia, rtol=5e-3)
    np.testing.assert_allclose(mesh.bounds[1], shape.half_extents(size), rtol=2e-3)
    way = np.array([0.48, -0.6, 0.64])
    assert shape.reach(size, way) == pytest.approx((mesh.vertices @ way).max(), rel=2e-3)
    with jax.enable_x64(True):
        sizes = jnp.asarray(size)[:, None, None]
        points = jnp.asarray(mesh.vertices.T[:, None])
        distance, _ = jax.jit(shapes.SHAPES[kind].distance)(sizes, points)
    assert np.abs(distance).max() < 1e-9  # trimesh rounds corners that it merges to 1e-8


RADIUS = 0.010
POSES = 1500


def poses():
    """Random object poses and sphere centres from deep inside to a hand's breadth away."""
    rng = np.random.default_rng(7)
    quat = rng.standard_normal((POSES, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    position = rng.uniform(-0.2, 0.2, (POSES, 3))
    # A third of the centres around the object's surface and edges, where regions meet.
    spread = np.where(np.arange(POSES) % 3 == 0, 0.05, 0.12)[:, None]
    return position, quat, position + rng.uniform(-spread, spread, (POSES, 3))


def reference(kind, position, quat, centre):
    """MuJoCo's distances and the normals from the object to the sphere where they are defined."""
    size = " ".join(map(str, SIZES[kind]))
    xml = f"""<mujoco><worldbody>
      <body mocap="true"><geom type="{kind}" size="{size}"/></body>
      <body mocap="true"><geom type="sphere" size="{RADIUS}"/></body>
    </worldbody></mujoco>"""
    data = mujoco.MjData(compiled := mujoco.MjModel.from_xml_string(xml))
    distance = np.zeros(POSES)
    normal = np.zeros((POSES, 3))
    points = np.zeros(6)
    for i in range(POSES):
        data.mocap_pos[:] = position[i], centre[i]
        data.mocap_quat[0] = quat[i]
        mujoco.mj_kinematics(compiled, data)
        distance[i] = mujoco.mj_geomDistance(compiled, data, 0, 1, 1.0, points)
        away = (points[3:] - points[:3]) * np.sign(distance[i])
        normal[i] = away / max(np.linalg.norm(away), 1e-300)
    return distance, normal


def engine_contacts(kind, position, quat, centre):
    """The engine's contacts for the same poses, one sphere a world, in float64."""
    columns = np.zeros((POSES, 9))
    for i in range(POSES):
        mujoco.mju_quat2Mat(columns[i], quat[i])
    with jax.enable_x64(True):
        alone = grasps.pinch(kind)
        size = np.broadcast_to(np.array(SIZES[kind])[:, None, None], (3, 1, POSES))
        frames = jnp.asarray(columns.reshape(POSES, 3, 3).transpose(2, 1, 0)[:, :, None])
        at = jnp.asarray((centre - position).T[:, None])  # frames: column, row, 1, world
        local = shapes.in_object(frames, at)
        shape = jnp.zeros((1, POSES), jnp.int32)
        distance, gradient = shapes.primitive_distance(alone, jnp.asarray(size), shape, local)
        return rings.ball_on_field(RADIUS, at, distance, apply_columns(frames, gradient))


@pytest.mark.parametrize("kind", KINDS)
def test_distances_equal_mujoco(kind):
    """Distance and normal of spheres outside of an object, and the depth of those that overlap."""
    position, quat, centre = poses()
    want, normal = reference(kind, position, quat, centre)
    got = engine_contacts(kind, position, quat, centre)
    gap = np.asarray(got.gap)[0]
    outside = gap > 1e-6
    inside = gap < -1e-6
    assert 0.2 < outside.mean() < 0.99 and inside.sum() > 100  # both kinds of poses are tried
    # Both are closed forms in float64; they differ by rounding of lengths below a metre.
    both = outside | inside
    np.testing.assert_allclose(gap[both], want[both], rtol=0, atol=1e-14)
    normals = np.asarray(got.normal)[:, 0].T
    # The witness points give the direction; two of them wrong by rounding, a gap apart, turn it.
    angle = np.linalg.norm(normals - normal, axis=1)
    near = outside & (gap > 1e-3)
    assert np.all(angle[near] < 1e-14 / gap[near])
    # Contact points lie half way between the surfaces.
    point = np.asarray(got.point)[:, 0].T
    back = centre - position - point
    np.testing.assert_allclose(np.linalg.norm(back, axis=1), np.abs(RADIUS + gap / 2), atol=1e-12)
