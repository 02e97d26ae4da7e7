"""A whole finger in three dimensions: nonlinear finite elements by NGSolve.

The finger is that of `elements`, with a length, end walls, a clamped base and a free tip:
neo-Hookean silicone, nearly incompressible; a thread in hoops and a fabric that resist tension
only; air that acts on the deformed walls and end walls.  Triquadratic displacements and a
continuous trilinear pressure (Taylor-Hood) on `hexahedra`.
"""

import ngsolve  # pyright: ignore[reportMissingImports]
import numpy as np
from netgen import meshing  # pyright: ignore[reportMissingImports]
from ngsolve import InnerProduct, ds, dx  # pyright: ignore[reportMissingImports]

from scripts.section import hexahedra
from scripts.section.elements import NoEquilibrium, Section

LOADS = ("force", "twist", "lateral")
"""Loads on the tip: a force across, moments about the finger and about its upright axis."""
MM = 1e3
"""Lengths are in mm within NGSolve, stresses in MPa and forces in N."""
UNITS = np.array([1.0, MM, MM])
"""Factors of the loads from N and N m to N and N mm, in the order of `LOADS`."""
LARGEST_STEP = 0.3
"""Largest displacement in an iteration of Newton's method, over the height."""
TOLERANCE = 1e-7
"""Residual of an equilibrium over G h^2."""


def _meshed(shape: hexahedra.Hexahedra) -> ngsolve.Mesh:
    mesh = meshing.Mesh()
    mesh.dim = 3
    for number, name in enumerate(shape.surfaces, 1):
        inner = int(name == "thread")
        mesh.Add(meshing.FaceDescriptor(surfnr=number, domin=1, domout=inner, bc=number))
        mesh.SetBCName(number - 1, name)
    mesh.SetMaterial(1, "silicone")
    ids = [mesh.Add(meshing.MeshPoint(meshing.Pnt(*(MM * p)))) for p in shape.nodes]
    for nodes in shape.elements:
        mesh.Add(meshing.Element3D(1, [ids[n] for n in nodes]))
    for number, quads in enumerate(shape.surfaces.values(), 1):
        for nodes in quads:
            mesh.Add(meshing.Element2D(number, [ids[n] for n in nodes]))
    return ngsolve.Mesh(mesh)


def _tension(strain: ngsolve.CF, stiffness: float, slack: float) -> ngsolve.CF:
    """Energy of fibres that resist tension only, as `elements.tension` has it."""
    root = ngsolve.sqrt(strain * strain + slack**2)
    arsinh = ngsolve.log((strain + root) / slack)
    return stiffness / 4 * (strain * (strain + root) + slack**2 * arsinh)


class Finger:
    """Equilibria of a finger, each from the one before.

    Attributes:
      pressure: Gauge pressure of the chamber [Pa].
      load: Loads on the tip in the order of `LOADS` [N, N m, N m].
    """

    def __init__(self, section: Section, length: float, end: float, along: int):
        if section.winding_angle:
            raise ValueError("the thread of a whole finger is wound in hoops")
        self.section = section
        self.shape = hexahedra.mesh(section, length, end, along)
        self.mesh = _meshed(self.shape)
        displacements = ngsolve.VectorH1(self.mesh, order=2, dirichlet="base")
        self.space = displacements * ngsolve.H1(self.mesh, order=1)
        self._free = self.space.FreeDofs()
        self._held = ~np.array(self._free, bool)
        self.solution = ngsolve.GridFunction(self.space)
        self.displacement = self.solution.components[0]
        self._pressure = ngsolve.Parameter(0.0)
        self._energy()
        self.rest()

    def rest(self) -> None:
        """Returns to the state without pressure and load."""
        self.solution.vec[:] = 0.0
        self._set(np.zeros(len(LOADS) + 1))
        self.aim()

    @property
    def pressure(self) -> float:
        return 1e6 * self._pressure.Get()

    def _energy(self) -> None:
        section = self.section
        modulus = 1e-6 * section.shear_modulus
        u, q = self.space.TrialFunction()
        f = ngsolve.Id(3) + ngsolve.Grad(u)
        det = ngsolve.Det(f)
        density = modulus / 2 * (InnerProduct(f, f) - 3 - 2 * ngsolve.log(det))
        density += modulus * q * (det - 1) - modulus / (2 * section.bulk_ratio) * q * q
        self._form = ngsolve.BilinearForm(self.space, symmetric=True)
        self._form += ngsolve.Variation(density.Compile() * dx)
        # Along the finger and around it: with the outward normal n, e_x x (n x e_x) = n.
        surface = ngsolve.Id(3) + ngsolve.Grad(u).Trace()
        normal = ngsolve.specialcf.normal(3)
        x = ngsolve.CF((1, 0, 0))
        y = ngsolve.CF((0, 1, 0))
        around = ngsolve.Cross(normal, x)
        position = ngsolve.CF((ngsolve.x, ngsolve.y, ngsolve.z)) + u.Trace()
        for name, first in (("chamber", x), ("cap", y)):
            second = ngsolve.Cross(normal, first)
            area = ngsolve.Cross(surface * first, surface * second)
            work = self._pressure / 3 * InnerProduct(position, area)
            self._form += ngsolve.Variation(work * ds(name))
        threads = {0.0: "outside|bottom", 1.0: "chamber|thread"}
        wound = threads.get(section.thread_depth, "thread")
        for name, stiffness, way in (
            (wound, section.thread_stiffness, around),
            ("bottom", section.fabric_stiffness, around),
            ("bottom", section.fabric_stiffness, x),
        ):
            if stiffness:
                strain = ngsolve.Norm(surface * way) - 1
                energy = _tension(strain, stiffness / MM, section.slack)
                self._form += ngsolve.Variation(energy * ds(name))

    # --- the tip ---------------------------------------------------------------------------------

    def _over_tip(self, value: ngsolve.CF) -> float:
        tip = self.mesh.Boundaries("tip")
        return ngsolve.Integrate(value, self.mesh, ngsolve.BND, definedon=tip)

    def tip_direction(self) -> np.ndarray:
        """Unit vector along the finger at its tip, shape (3,)."""
        upright = self._upright()
        return np.array([upright[2], 0.0, -upright[0]])

    def _upright(self) -> np.ndarray:
        """Unit vector of the tip from the fabric to the top, without its part across."""
        height = ngsolve.z - MM * self.section.height / 2
        square = self._over_tip(height * height)
        slope = [self._over_tip(self.displacement[i] * height) / square for i in (0, 2)]
        vector = np.array([slope[0], 0.0, 1 + slope[1]])
        return vector / np.linalg.norm(vector)

    def angle(self) -> float:
        """Angle by which the tip is bent towards the fabric [rad]."""
        upright = self._upright()
        return float(np.arctan2(upright[0], upright[2]))

    def aim(self) -> None:
        """Turns the directions of the loads to those of the tip as it is."""
        upright = ngsolve.CF(tuple(self._upright()))
        forward = ngsolve.CF(tuple(self.tip_direction()))
        across = ngsolve.CF((0, 1, 0))
        up = ngsolve.z - MM * self.section.height / 2
        area = self._over_tip(ngsolve.CF(1.0))
        polar = self._over_tip(ngsolve.y * ngsolve.y + up * up)
        wide = self._over_tip(ngsolve.y * ngsolve.y)
        # Forces over the tip that do as much work on a rigid motion as the load.
        densities = (
            across / area,
            (ngsolve.y * upright - up * across) / polar,
            -ngsolve.y * forward / wide,
        )
        v, _ = self.space.TestFunction()
        self._loads = []
        for density in densities:
            form = ngsolve.LinearForm(InnerProduct(density, v.Trace()) * ds("tip"))
            form.Assemble()
            self._loads.append(form.vec.FV().NumPy().copy())

    def compliance(self) -> np.ndarray:
        """Displacement [m] and two rotations [rad] of the tip over small loads of 1, shape (3, 3).

        Rows are what `moved` returns, columns the loads in the order of `LOADS`.
        """
        self._form.AssembleLinearization(self.solution.vec)
        inverse = self._form.mat.Inverse(self._free, inverse="sparsecholesky")
        answer = ngsolve.GridFunction(self.space)
        right = self.solution.vec.CreateVector()
        columns = []
        for load, unit in zip(self._loads, UNITS, strict=True):
            right.FV().NumPy()[:] = unit * load
            answer.vec.data = inverse * right
            columns.append(self._moved(answer))
        return np.transpose(columns)

    def _moved(self, solution: ngsolve.GridFunction) -> np.ndarray:
        values = np.array(self._loads) @ solution.vec.FV().NumPy()
        return values / [MM, 1.0, 1.0]

    def _at_nodes(self) -> np.ndarray:
        """Displacements of the mesh's nodes [m]: of the hierarchical basis the first numbers."""
        parts = self.displacement.components
        return np.transpose([c.vec.FV().NumPy()[: self.mesh.nv] for c in parts]) / MM

    def moved(self) -> np.ndarray:
        """Displacement and rotations of the tip in the order of `LOADS` [m, rad, rad]."""
        return self._moved(self.solution)

    def positions(self) -> np.ndarray:
        """Positions of the mesh's nodes [m], shape (node, 3)."""
        return self.shape.nodes + self._at_nodes()

    # --- equilibria ------------------------------------------------------------------------------

    def solve(self, rounds: int = 14) -> int:
        """Equilibrium at the present pressure and load; iterations that it took."""
        vector = self.solution.vec
        before = vector.FV().NumPy().copy()
        residual = vector.CreateVector()
        step = vector.CreateVector()
        height = MM * self.section.height
        small = TOLERANCE * 1e-6 * self.section.shear_modulus * height**2
        force = self.load * UNITS @ np.array(self._loads)
        moved = slice(0, self.space.components[0].ndof)
        for count in range(rounds):
            self._form.Apply(vector, residual)
            values = residual.FV().NumPy()
            values -= force
            values[self._held] = 0.0
            if not np.isfinite(values).all():
                break
            if np.abs(values).max() < small:
                return count
            self._form.AssembleLinearization(vector)
            step.data = self._form.mat.Inverse(self._free, inverse="sparsecholesky") * residual
            change = step.FV().NumPy()
            largest = np.abs(change[moved]).max() / height
            if not np.isfinite(largest):
                break
            vector.FV().NumPy()[:] -= min(1.0, LARGEST_STEP / max(largest, 1e-300)) * change
        vector.FV().NumPy()[:] = before
        raise NoEquilibrium("the Newton iteration did not converge")

    def reach(self, pressure: float, load: np.ndarray | None = None, *, steps: int = 1) -> None:
        """`solve` in steps from the present state, which are halved where one does not converge."""
        vector = self.solution.vec.FV().NumPy()
        begin = np.append(self.load, self.pressure)
        change = np.append(self.load if load is None else load, pressure) - begin
        share = 0.0
        step = 1.0 / steps
        last = None
        while share < 1:
            to = min(1.0, share + step)
            present = vector.copy()
            if last is not None:
                vector[:] = present + (to - share) / (share - last[0]) * (present - last[1])
            self._set(begin + to * change)
            try:
                count = self.solve()
            except NoEquilibrium:
                vector[:] = present
                self._set(begin + share * change)
                step /= 2
                if step < 2e-3:
                    raise
            else:
                last = share, present
                share = to
                step *= 1.5 if count < 6 else 1.0

    def _set(self, values: np.ndarray) -> None:
        self.load = values[:-1]
        self._pressure.Set(1e-6 * values[-1])

    def volume(self) -> float:
        """Volume of the chamber [m^3]; it has end walls."""
        gradient = ngsolve.Grad(self.displacement)
        normal = ngsolve.specialcf.normal(3)
        area = ngsolve.Cof(ngsolve.Id(3) + gradient) * normal
        position = ngsolve.CF((ngsolve.x, ngsolve.y, ngsolve.z)) + self.displacement
        faces = self.mesh.Boundaries("chamber|cap")
        work = InnerProduct(position, area)
        integral = ngsolve.Integrate(work, self.mesh, ngsolve.BND, definedon=faces)
        return -integral / 3 / MM**3
