"""A finger whose strain is the same all along: nonlinear finite elements of its section.

Such a finger is a helix.  Its sections deform alike, so that a material point at the arc length X
has the position x = r(X) + R(X) w(Y, Z) with unknowns w on the section alone, and the deformation
gradient in the frame R is exact:

  F = [gamma e_x + kappa x w, dw/dY, dw/dZ],  kappa = (twist, bend, lateral).

Y runs across the section and Z up from the fabric.  A positive bend stretches fibres above the
fabric.  All energies are per length of the finger:

* silicone: neo-Hookean, nearly incompressible, biquadratic elements with a linear pressure each;
* thread: fibres bonded along a rectangle inside the wall, which resist tension only;
* fabric: the same along and across the bottom;
* air: -p V with the volume V = gamma e_x . oint w x dw / 2 - kappa . oint |w|^2 dw / 2 over the
  chamber's contour, so that pressure on the deformed walls and on the end walls is included.

A Newton iteration with exact second derivatives finds the equilibrium; those of the remaining
energy by the curvatures are the section's 3 x 3 stiffness.
"""

import dataclasses
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

CURVATURES = ("twist", "bend", "lateral")
_POINTS = np.sqrt(0.6) * np.array([-1.0, 0.0, 1.0])
_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 9
_CROSS = np.zeros((3, 3, 3))
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _CROSS[_i, _j, _k] = 1.0
    _CROSS[_j, _i, _k] = -1.0
"""(e_i x e_j)_k."""


class NoEquilibrium(ArithmeticError):
    """The Newton iteration did not converge."""


@dataclasses.dataclass(frozen=True)
class Section:
    """A finger's section.

    Attributes:
      width: Outer width [m].
      height: Outer height [m].
      wall: Thickness of all walls [m].
      shear_modulus: G of the silicone [Pa].
      bulk_ratio: Bulk modulus over G.
      thread_stiffness: Force per strain of the thread and per length of finger [N/m]; 0: none.
      thread_depth: Place of the thread in the wall: 0 outside, 1 on the chamber.
      winding_angle: Angle of the thread to the hoop direction [rad].
      crossed: Whether the thread is wound there and back.
      fabric_stiffness: Force per strain and width of the fabric, along and across [N/m]; 0: none.
      slack: Strain over which thread and fabric tighten.
      layers: Elements through the wall.
      sides: Elements along bottom, right, top and left; the first number is even.
      round: Whether outside and chamber are circles of the diameters w and w - 2 d.
    """

    width: float = 24e-3
    height: float = 20e-3
    wall: float = 5e-3
    shear_modulus: float = 88e3
    bulk_ratio: float = 1000.0
    thread_stiffness: float = 1e5
    thread_depth: float = 0.0
    winding_angle: float = 0.0
    crossed: bool = True
    fabric_stiffness: float = 1e5
    slack: float = 1e-4
    layers: int = 2
    sides: tuple[int, int, int, int] = (6, 4, 6, 4)
    round: bool = False

    def depths(self) -> np.ndarray:
        """Places of the element layers' boundaries in the wall, the thread's among them."""
        even = np.linspace(0, 1, self.layers + 1)
        if self.thread_depth in (0.0, 1.0):
            return even
        inner = even[1:-1]
        if self.layers < 2:
            raise ValueError("a thread inside the wall needs two layers of elements")
        inner[np.abs(inner - self.thread_depth).argmin()] = self.thread_depth
        return np.sort(np.concatenate([[0.0], inner, [1.0]]))


def _line(t: float) -> np.ndarray:
    return np.array([t * (t - 1) / 2, 1 - t * t, t * (t + 1) / 2])


def _line_slope(t: float) -> np.ndarray:
    return np.array([t - 0.5, -2 * t, t + 0.5])


def rectangle(low: np.ndarray, high: np.ndarray, sides: tuple[int, int, int, int]) -> np.ndarray:
    """Nodes on a rectangle between two corners, counterclockwise, shape (2 n, 2)."""
    corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
    parts = []
    for start, end, count in zip(corners, np.roll(corners, -1, 0), sides, strict=True):
        share = np.arange(2 * count)[:, None] / (2 * count)
        parts.append((1 - share) * start + share * end)
    return np.concatenate(parts)


def contours(section: Section) -> tuple[np.ndarray, np.ndarray]:
    """Nodes on the outer contour and on the chamber's, from the bottom left, shape (2 n, 2)."""
    if section.round:
        count = 2 * sum(section.sides)
        angle = -np.pi / 2 + 2 * np.pi * (np.arange(count) - section.sides[0]) / count
        unit = np.stack([np.cos(angle), np.sin(angle)], 1)
        radius = section.width / 2
        centre = np.array([0.0, radius])
        return unit * radius + centre, unit * (radius - section.wall) + centre

    def box(margin: float) -> np.ndarray:
        half = section.width / 2 - margin
        low = np.array([-half, margin])
        return rectangle(low, np.array([half, section.height - margin]), section.sides)

    return box(0.0), box(section.wall)


class _Edges:
    """Elements of three nodes along a contour, counterclockwise: 13 unknowns each.

    They are w of the nodes (9), gamma and kappa.
    """

    def __init__(self, nodes: np.ndarray, edges: np.ndarray, places: np.ndarray, strains: Any):
        self.places = np.array([_line(t) for t in _POINTS])
        self.slopes = np.array([_line_slope(t) for t in _POINTS])
        self.nodes = edges
        shared = np.broadcast_to(strains, (len(edges), 4))
        self.unknowns = np.concatenate([places[edges].reshape(len(edges), 9), shared], 1)
        tangent = np.einsum("qn,enb->eqb", self.slopes, nodes[edges])
        self.arc = np.linalg.norm(tangent, axis=2)
        """Reference length per coordinate, shape (edge, point)."""
        eye = np.eye(3)
        self.position = np.zeros((3, 3, 13))
        self.position[..., :9] = np.einsum("qn,ij->qinj", self.places, eye).reshape(3, 3, 9)
        self.tangent = np.zeros((3, 3, 13))
        self.tangent[..., :9] = np.einsum("qn,ij->qinj", self.slopes, eye).reshape(3, 3, 9)


class Model:
    """Equilibria of a section, each from the one before.

    Attributes:
      state: Unknowns: w of each node, pressures of the elements over G, gamma, kappa.
      pressure: Gauge pressure of the chamber [Pa].
    """

    def __init__(self, section: Section):
        self.section = section
        outer, inner = contours(section)
        depths = section.depths()
        share = np.sort(np.concatenate([depths, (depths[1:] + depths[:-1]) / 2]))
        around, through = len(outer), len(share)
        number = np.arange(around * through).reshape(around, through)
        mixed = (1 - share)[:, None] * outer[:, None] + share[:, None] * inner[:, None]
        self.nodes = mixed.reshape(-1, 2)
        self.elements = np.array(
            [
                [number[(2 * i + a) % around, 2 * j + b] for a in range(3) for b in range(3)]
                for i in range(around // 2)
                for j in range(through // 2)
            ]
        )
        first = section.sides[0]
        # Rigid motion: the middle of the bottom is the origin, its corners stay level.
        self._origin = number[first, 0]
        places = np.arange(3 * len(self.nodes)).reshape(-1, 3)
        places[number[2 * first, 0], 2] = places[number[0, 0], 2]
        self._places = places
        start = 3 * len(self.nodes)
        count = len(self.elements)
        pressures = start + np.arange(3 * count).reshape(count, 3)
        self._strains = start + 3 * count + np.arange(4)
        self._size = start + 3 * count + 4
        shared = np.broadcast_to(self._strains, (count, 4))
        self._unknowns = np.concatenate(
            [places[self.elements].reshape(count, 27), pressures, shared], 1
        )

        def contour(depth: float, last: int) -> _Edges:
            layer = int(np.argmin(np.abs(share - depth)))
            edges = [[number[(2 * i + a) % around, layer] for a in range(3)] for i in range(last)]
            return _Edges(self.nodes, np.array(edges), places, self._strains)

        self.chamber = contour(1.0, around // 2)
        self.threads = contour(section.thread_depth, around // 2)
        self.outside = contour(0.0, around // 2)
        self.fabric = contour(0.0, first)
        self._prepare()
        self.rest()

    def _prepare(self) -> None:
        """Shape functions at 3 x 3 points of each element."""
        shape = []
        slope = []
        pressure = []
        weight = []
        for a, wa in zip(_POINTS, _WEIGHTS, strict=True):
            for b, wb in zip(_POINTS, _WEIGHTS, strict=True):
                shape.append(np.outer(_line(a), _line(b)).ravel())
                slope.append(
                    [
                        np.outer(_line_slope(a), _line(b)).ravel(),
                        np.outer(_line(a), _line_slope(b)).ravel(),
                    ]
                )
                pressure.append([1.0, a, b])
                weight.append(wa * wb)
        self._shape = np.array(shape)
        self._pressure = np.array(pressure)
        slopes = np.array(slope)
        jacobian = np.einsum("qan,enb->eqab", slopes, self.nodes[self.elements])
        self._weight = np.abs(np.linalg.det(jacobian)) * np.array(weight)
        self._slope = np.einsum("eqba,qan->eqbn", np.linalg.inv(jacobian), slopes)
        groups = [self._unknowns, self.chamber.unknowns]
        if self.section.thread_stiffness:
            groups.append(self.threads.unknowns)
        if self.section.fabric_stiffness:
            groups.append(self.fabric.unknowns)
        self._all = np.concatenate([g.ravel() for g in groups])
        self._rows = np.concatenate([np.repeat(g, g.shape[1], 1).ravel() for g in groups])
        self._columns = np.concatenate([np.tile(g, (1, g.shape[1])).ravel() for g in groups])

    def rest(self) -> None:
        """Returns to the state without pressure and curvature."""
        self.state = np.zeros(self._size)
        self.state[self._places[:, 1]] = self.nodes[:, 0]
        self.state[self._places[:, 2]] = self.nodes[:, 1]
        self.state[self._strains[0]] = 1.0
        self.pressure = 0.0

    @property
    def kappa(self) -> np.ndarray:
        """Twist, bend and lateral curvature [1/m]."""
        return self.state[self._strains[1:]]

    @property
    def stretch(self) -> float:
        """Stretch of the line at the origin."""
        return float(self.state[self._strains[0]])

    def positions(self) -> np.ndarray:
        """w of every node [m], shape (node, 3)."""
        return self.state[self._places]

    # --- energies: value, gradient and second derivatives of every element -----------------------

    def _solid(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        modulus = self.section.shear_modulus
        bulk = modulus * self.section.bulk_ratio
        z = state[self._unknowns]
        w = z[:, :27].reshape(-1, 9, 3)
        gamma = z[:, 30]
        kappa = z[:, 31:]
        at = np.einsum("qn,eni->eqi", self._shape, w)
        first = np.cross(kappa[:, None], at)
        first[..., 0] += gamma[:, None]
        others = np.einsum("eqan,eni->eqai", self._slope, w)
        f = np.stack([first, others[:, :, 0], others[:, :, 1]], -1)
        det = np.linalg.det(f)
        if det.min() <= 0:
            raise NoEquilibrium("an element is turned inside out")
        pressure = modulus * np.einsum("qa,ea->eq", self._pressure, z[:, 27:30])
        weight = self._weight
        density = modulus / 2 * ((f**2).sum((2, 3)) - 3 - 2 * np.log(det))
        density += pressure * (det - 1) - pressure**2 / (2 * bulk)
        # Column a of the cofactors is d det / d F_ia.
        inverse = np.swapaxes(np.linalg.inv(f), -1, -2)
        cofactor = det[..., None, None] * inverse
        stress = modulus * (f - inverse) + pressure[..., None, None] * cofactor
        outer = np.einsum("eqia,eqjb->eqiajb", inverse, inverse)
        swapped = np.einsum("eqib,eqja->eqiajb", inverse, inverse)
        scaled = (pressure * det)[..., None, None, None, None]
        second = scaled * (outer - swapped) + modulus * swapped
        second += modulus * np.einsum("ij,ab->iajb", np.eye(3), np.eye(3))
        # Linear map from the unknowns without the pressures to F.
        count, points = det.shape
        linear = np.zeros((count, points, 3, 3, 34))
        eye = np.eye(3)
        nodal = linear[..., :27].reshape(count, points, 3, 3, 9, 3)
        # (kappa x e_j)_i
        turn = np.einsum("kji,ek->eij", _CROSS, kappa)
        nodal[:, :, :, 0] = np.einsum("qn,eij->eqinj", self._shape, turn)
        nodal[:, :, :, 1] = np.einsum("eqn,ij->eqinj", self._slope[:, :, 0], eye)
        nodal[:, :, :, 2] = np.einsum("eqn,ij->eqinj", self._slope[:, :, 1], eye)
        linear[..., :27] = nodal.reshape(count, points, 3, 3, 27)
        linear[:, :, 0, 0, 30] = 1.0
        linear[:, :, :, 0, 31:] = np.einsum("kji,eqj->eqik", _CROSS, at)
        flat = linear.reshape(count, points, 9, 34)
        stress = weight[..., None, None] * stress
        gradient = np.einsum("eqc,eqcd->ed", stress.reshape(count, points, 9), flat)
        by_pressure = modulus * self._pressure
        gradient[:, 27:30] += (weight * (det - 1 - pressure / bulk)) @ by_pressure
        hessian = _quadratic(weight[..., None, None] * second.reshape(count, points, 9, 9), flat)
        slope = weight[..., None] * (cofactor.reshape(count, points, 1, 9) @ flat)[:, :, 0]
        mixed = by_pressure.T @ slope
        hessian[:, 27:30] += mixed
        hessian[:, :, 27:30] += np.swapaxes(mixed, 1, 2)
        hessian[:, 27:30, 27:30] -= by_pressure.T @ (weight[..., None] * by_pressure) / bulk
        # First column of F is bilinear in kappa and w.
        nodal = np.einsum("eqi,qn->eni", stress[..., 0], self._shape)
        bilinear = np.einsum("eni,kji->eknj", nodal, _CROSS).reshape(count, 3, 27)
        hessian[:, 31:, :27] += bilinear
        hessian[:, :27, 31:] += np.swapaxes(bilinear, 1, 2)
        return (density * weight).sum(1), gradient, hessian

    def _air(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Volume of the chamber per length."""
        edges = self.chamber
        z = state[edges.unknowns]
        at = np.einsum("qid,ed->eqi", edges.position, z)
        along = np.einsum("qid,ed->eqi", edges.tangent, z)
        gamma = z[:, 9]
        kappa = z[:, 10:]
        twice = np.cross(at, along)[..., 0]
        square = (at**2).sum(-1)
        around = np.einsum("ei,eqi->eq", kappa, along)
        value = (gamma[:, None] * twice - square * around) / 2
        # Local variables: position, tangent, gamma, kappa.
        count = len(z)
        linear = np.zeros((3, 10, 13))
        linear[:, :3] = edges.position
        linear[:, 3:6] = edges.tangent
        linear[:, 6:, 9:] = np.eye(4)
        axis = np.array([[0.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # twice = at . axis . along
        gradient = np.zeros((count, 3, 10))
        gradient[..., :3] = gamma[:, None, None] / 2 * (along @ axis.T) - around[..., None] * at
        gradient[..., 3:6] = gamma[:, None, None] / 2 * (at @ axis)
        gradient[..., 3:6] -= square[..., None] / 2 * kappa[:, None]
        gradient[..., 6] = twice / 2
        gradient[..., 7:] = -square[..., None] / 2 * along
        second = np.zeros((count, 3, 10, 10))
        eye = np.eye(3)
        second[..., :3, :3] = -around[..., None, None] * eye / 2
        second[..., :3, 3:6] = gamma[:, None, None, None] / 2 * axis
        second[..., :3, 3:6] -= at[..., :, None] * kappa[:, None, None, :]
        second[..., :3, 6] = along @ axis.T / 2
        second[..., :3, 7:] = -at[..., :, None] * along[..., None, :]
        second[..., 3:6, 6] = at @ axis / 2
        second[..., 3:6, 7:] = -square[..., None, None] / 2 * eye
        second = second + np.swapaxes(second, -1, -2)
        return (
            value @ _WEIGHTS,
            np.einsum("eqc,qcd->ed", gradient, _WEIGHTS[:, None, None] * linear),
            _quadratic(
                _WEIGHTS[:, None, None] * second, np.broadcast_to(linear, (count, 3, 10, 13))
            ),
        )

    def _fibres(
        self, edges: _Edges, state: np.ndarray, stiffness: float, around: float, along: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Energy of fibres with these components of their reference direction."""
        z = state[edges.unknowns]
        at = np.einsum("qid,ed->eqi", edges.position, z)
        tangent = np.einsum("qid,ed->eqi", edges.tangent, z)
        kappa = z[:, 10:]
        count = len(z)
        vector = along * np.cross(kappa[:, None], at)
        vector[..., 0] += along * z[:, 9, None]
        vector += around * tangent / edges.arc[..., None]
        length = np.linalg.norm(vector, axis=-1)
        value, force, slope = tension(length - 1, stiffness, self.section.slack)
        weight = _WEIGHTS * edges.arc
        unit = vector / length[..., None]
        turn = np.einsum("kji,ek->eij", _CROSS, kappa)
        linear = around * edges.tangent / edges.arc[..., None, None]
        linear = linear + along * np.einsum("eij,qjd->eqid", turn, edges.position)
        linear[..., 0, 9] += along
        linear[..., 10:] += along * np.einsum("kji,eqj->eqik", _CROSS, at)
        pull = (weight * force)[..., None] * unit
        gradient = np.einsum("eqi,eqid->ed", pull, linear)
        both = unit[..., :, None] * unit[..., None, :]
        across = (force / length)[..., None, None] * (np.eye(3) - both)
        second = slope[..., None, None] * both + across
        hessian = _quadratic(weight[..., None, None] * second, linear)
        nodal = np.einsum("eqi,qn->eni", pull, edges.places)
        bilinear = along * np.einsum("eni,kji->eknj", nodal, _CROSS).reshape(count, 3, 9)
        hessian[:, 10:, :9] += bilinear
        hessian[:, :9, 10:] += np.swapaxes(bilinear, 1, 2)
        return (value * weight).sum(1), gradient, hessian

    def _energies(self, state: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        section = self.section
        parts = [self._solid(state), tuple(-self.pressure * v for v in self._air(state))]
        if section.thread_stiffness:
            around = np.cos(section.winding_angle)
            along = np.sin(section.winding_angle)
            if section.crossed and along:
                half = section.thread_stiffness / 2
                both = [
                    self._fibres(self.threads, state, half, around, sign * along)
                    for sign in (1, -1)
                ]
                parts.append(tuple(a + b for a, b in zip(*both, strict=True)))
            else:
                stiffness = section.thread_stiffness
                parts.append(self._fibres(self.threads, state, stiffness, around, along))
        if section.fabric_stiffness:
            warp = self._fibres(self.fabric, state, section.fabric_stiffness, 0.0, 1.0)
            weft = self._fibres(self.fabric, state, section.fabric_stiffness, 1.0, 0.0)
            parts.append(tuple(a + b for a, b in zip(warp, weft, strict=True)))
        return parts

    def derivatives(self, state: np.ndarray) -> tuple[float, np.ndarray, Any]:
        """Energy per length, its gradient and its sparse second derivatives."""
        parts = self._energies(state)
        energy = float(sum(p[0].sum() for p in parts))
        values = np.concatenate([p[1].ravel() for p in parts])
        gradient = np.bincount(self._all, values, self._size)
        values = np.concatenate([p[2].ravel() for p in parts])
        shape = (self._size, self._size)
        hessian = scipy.sparse.csc_matrix((values, (self._rows, self._columns)), shape)
        return energy, gradient, hessian

    # --- equilibrium ------------------------------------------------------------------------------

    def _free(self, fixed: Any) -> np.ndarray:
        free = np.zeros(self._size, bool)
        free[np.unique(self._all)] = True
        free[self._places[self._origin]] = False
        for name in fixed:
            free[self._strains[1 + CURVATURES.index(name)]] = False
        return np.flatnonzero(free)

    def solve(self, pressure: float, *, rounds: int = 14, **kappa: float) -> np.ndarray:
        """Finds the equilibrium at a pressure and curvatures; curvatures without a value are free.

        Returns:
          The external moments (twist, bend, lateral) that hold the curvatures [N m].

        Raises:
          NoEquilibrium: If the iteration does not converge; the state is the one before.
        """
        before = self.state, self.pressure
        try:
            return self._newton(pressure, rounds, kappa)
        except NoEquilibrium:
            self.state, self.pressure = before
            raise

    def _newton(self, pressure: float, rounds: int, kappa: dict[str, float]) -> np.ndarray:
        self.pressure = pressure
        state = self.state.copy()
        for name, value in kappa.items():
            state[self._strains[1 + CURVATURES.index(name)]] = value
        free = self._free(kappa)
        height = self.section.height
        # Residuals are forces per length, moments and, of the pressures, areas times G.
        scale = np.full(self._size, self.section.shear_modulus * height)
        scale[self._unknowns[:, 27:30]] *= height
        scale[int(self._strains[0])] *= height
        scale[self._strains[1:]] *= height**2
        for _ in range(rounds):
            _, gradient, hessian = self.derivatives(state)
            residual = gradient[free]
            if (np.abs(residual) < 1e-7 * scale[free]).all():
                self.state = state
                return gradient[self._strains[1:]]
            step = np.zeros(self._size)
            solved = scipy.sparse.linalg.spsolve(hessian[free][:, free], -residual)
            step[free] = np.asarray(solved)
            if not np.isfinite(step).all():
                break
            largest = np.abs(step[self._places]).max() / height
            state = state + min(1.0, 0.3 / max(largest, 1e-300)) * step
        raise NoEquilibrium("the Newton iteration did not converge")

    def reach(self, pressure: float, *, steps: int = 1, **kappa: float) -> np.ndarray:
        """`solve` in steps from the present state, which are halved where one does not converge."""
        start = self.pressure
        old = {n: self.kappa[CURVATURES.index(n)] for n in kappa}
        share = 0.0
        step = 1.0 / steps
        moments = np.zeros(3)
        while share < 1:
            to = min(1.0, share + step)
            if 1 - to < 1e-9:
                to = 1.0
            try:
                moments = self.solve(
                    start + to * (pressure - start),
                    **{n: old[n] + to * (v - old[n]) for n, v in kappa.items()},
                )
            except NoEquilibrium:
                step /= 2
                if step < 2e-3:
                    raise
            else:
                share = to
                step *= 1.5
        return moments

    def stiffness(self) -> np.ndarray:
        """Second derivatives of the energy by the curvatures at constant pressure [N m^2]."""
        _, _, hessian = self.derivatives(self.state)
        rest = self._free(CURVATURES)
        held = self._strains[1:]
        coupling = hessian[rest][:, held].toarray()
        relaxed = scipy.sparse.linalg.splu(hessian[rest][:, rest].tocsc()).solve(coupling)
        return hessian[held][:, held].toarray() - coupling.T @ relaxed

    def energy(self) -> float:
        """Energy per length, with that of the pressure, -p V [N]."""
        return float(sum(p[0].sum() for p in self._energies(self.state)))

    def volume(self) -> float:
        """Volume of the chamber per length of the unloaded finger [m^2]."""
        return float(self._air(self.state)[0].sum())

    def fabric_tension(self) -> float:
        """Tension of the fabric along the finger [N]."""
        edges = self.fabric
        z = self.state[edges.unknowns]
        at = np.einsum("qid,ed->eqi", edges.position, z)
        vector = np.cross(z[:, None, 10:], at)
        vector[..., 0] += z[:, 9, None]
        strain = np.linalg.norm(vector, axis=-1) - 1
        force = tension(strain, self.section.fabric_stiffness, self.section.slack)[1]
        return float((force * _WEIGHTS * edges.arc).sum())


def _quadratic(second: np.ndarray, linear: np.ndarray) -> np.ndarray:
    """Sum over points of linear' second linear, shape (element, unknown, unknown)."""
    count, points, rows, size = linear.shape
    right = (second @ linear).reshape(count, points * rows, size)
    return np.swapaxes(linear.reshape(count, points * rows, size), 1, 2) @ right


def tension(strain: np.ndarray, stiffness: float, slack: float) -> tuple:
    """Energy, force and stiffness of fibres that resist tension only, smooth over a strain."""
    root = np.sqrt(strain**2 + slack**2)
    energy = stiffness / 4 * (strain * (strain + root) + slack**2 * np.arcsinh(strain / slack))
    return energy, stiffness / 2 * (strain + root), stiffness / 2 * (1 + strain / root)
