"""Interactive charts of a run for its report (plotly, the extra `report`)."""

import itertools

import numpy as np
import plotly.graph_objects as go
import plotly.io
from plotly.subplots import make_subplots

from codesign_jax.codesign import CONVERGED_COST
from codesign_jax.report.landscape import Landscape
from codesign_jax.runs.record import History
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.types import WARNINGS, Forces, Status

_BLUE, _ORANGE, _GREY = "#2f6fab", "#e08a1e", "#5a6776"
_LAYOUT = {
    "template": "plotly_white",
    "margin": {"l": 60, "r": 20, "t": 30, "b": 50},
    "font": {"family": "system-ui, sans-serif", "size": 13},
}
_COLUMNS = 3  # of the grid of parameters


def html(figure: go.Figure, name: str) -> str:
    """A figure as a piece of a page that has plotly.js."""
    return plotly.io.to_html(
        figure,
        include_plotlyjs=False,
        full_html=False,
        div_id=name,
        config={"displaylogo": False, "responsive": True},
    )


def plotly_source() -> str:
    """The source of plotly.js, for a page that needs no network."""
    import plotly.offline

    return plotly.offline.get_plotlyjs()


def cost_evolution(history: History) -> go.Figure:
    """Costs of all particles over the episodes, their mean and the threshold of convergence."""
    episodes, particles = history.cost.shape
    number = np.arange(1, episodes + 1)
    figure = go.Figure()
    figure.add_scatter(
        x=np.repeat(number, particles),
        y=history.cost.ravel(),
        mode="markers",
        name="particle",
        marker={"color": _BLUE, "size": 5, "opacity": 0.45},
        hovertemplate="episode %{x}: cost %{y:.3f}<extra></extra>",
    )
    mean = {"color": _ORANGE, "width": 3}
    figure.add_scatter(
        x=number, y=history.cost.mean(1), mode="lines", name="mean of the particles", line=mean
    )
    best = {"color": _GREY, "width": 1.5}
    figure.add_scatter(
        x=number, y=history.cost.min(1), mode="lines", name="best particle", line=best
    )
    figure.add_hline(CONVERGED_COST, line={"dash": "dash", "width": 1})
    figure.update_layout(xaxis_title="episode", yaxis_title="cost", height=380, **_LAYOUT)
    figure.update_xaxes(dtick=_step(episodes))
    return figure


def parameter_chart(history: History, space: DesignSpace, chosen: np.ndarray) -> go.Figure:
    """Distribution of every parameter over the episodes: range, quartiles and median.

    Args:
      chosen: The chosen design [SI units], shape (parameter,), drawn as a line.
    """
    count = space.num_parameters
    columns = min(_COLUMNS, count)
    rows = -(-count // columns)
    titles = [f"{n} [{u}]" for n, u in zip(space.names, space.units, strict=True)]
    figure = make_subplots(rows, columns, subplot_titles=titles, vertical_spacing=0.35 / rows)
    values, low, high = (
        space.in_units(np.array(v)) for v in (history.population, space.low, space.high)
    )
    number, shown = np.arange(1, len(values) + 1), space.in_units(chosen)
    for k, (row, column) in zip(
        range(count), itertools.product(range(1, rows + 1), range(1, columns + 1)), strict=False
    ):
        place = {"row": row, "col": column, "showlegend": k == 0}
        for lower, upper, shade, name in ((0, 100, 0.15, "range"), (25, 75, 0.3, "quartiles")):
            low_line, high_line = np.percentile(values[..., k], [lower, upper], axis=1)
            figure.add_scatter(
                x=np.concatenate([number, number[::-1]]),
                y=np.concatenate([high_line, low_line[::-1]]),
                mode="lines",
                fill="toself",
                fillcolor=f"rgba(47, 111, 171, {shade})",
                line={"width": 0},
                hoverinfo="skip",
                name=name,
                legendgroup=name,
                **place,
            )
        median = {"color": _BLUE, "width": 2}
        figure.add_scatter(
            x=number,
            y=np.median(values[..., k], 1),
            mode="lines",
            name="median",
            line=median,
            legendgroup="m",
            **place,
        )
        figure.add_scatter(
            x=[1, len(values)],
            y=[shown[k]] * 2,
            mode="lines",
            name="chosen design",
            line={"color": _ORANGE, "width": 1.5, "dash": "dot"},
            legendgroup="c",
            **place,
        )
        figure.update_yaxes(range=[low[k], high[k]], row=row, col=column)
    figure.update_layout(height=130 + 190 * rows, **_LAYOUT)
    figure.update_layout(
        legend={"orientation": "h", "y": 1.0 + 60 / (130 + 190 * rows), "yanchor": "bottom"}
    )
    figure.update_layout(margin_t=90)
    figure.update_xaxes(dtick=_step(2 * len(values)))  # small axes
    return figure


def designs(
    history: History, space: DesignSpace, chosen: np.ndarray, landscape: Landscape | None
) -> go.Figure:
    """All particles of a run with two parameters, over the landscape where there is one.

    Args:
      chosen: The chosen design [SI units], shape (2,).
    """
    x, y = space.in_units(history.population.reshape(-1, 2)).T
    episode = np.repeat(np.arange(1, len(history.cost) + 1), history.cost.shape[1])
    figure = go.Figure()
    if landscape is not None:
        figure.add_trace(_heatmap(landscape))
    marker = {"size": 6, "color": history.cost.ravel(), "colorscale": "Viridis", "cmin": 0}
    marker |= {"line": {"width": 0.5, "color": "white"}, "colorbar": {"title": "cost", "x": 1.0}}
    figure.add_scatter(
        x=x,
        y=y,
        mode="markers",
        name="particle",
        marker=marker,
        customdata=np.stack([episode, history.cost.ravel()], -1),
        hovertemplate="%{x:.4g}, %{y:.4g}: cost %{customdata[1]:.3f}, "
        "episode %{customdata[0]}<extra></extra>",
    )
    at = space.in_units(chosen)
    star = {"symbol": "star", "size": 16, "color": _ORANGE, "line": {"width": 1, "color": "black"}}
    figure.add_scatter(x=at[:1], y=at[1:], mode="markers", name="chosen design", marker=star)
    axes = [f"{n} [{u}]" for n, u in zip(space.names, space.units, strict=True)]
    figure.update_layout(xaxis_title=axes[0], yaxis_title=axes[1], height=460, **_LAYOUT)
    figure.update_layout(legend={"orientation": "h", "y": 1.02, "yanchor": "bottom"})
    return figure


def landscape_figure(found: Landscape) -> go.Figure:
    """The landscape alone."""
    figure = go.Figure(_heatmap(found))
    axes = [f"{n} [{u}]" for n, u in zip(found.names, found.units, strict=True)]
    figure.update_layout(xaxis_title=axes[0], yaxis_title=axes[1], height=460, **_LAYOUT)
    return figure


def _heatmap(found: Landscape) -> go.Heatmap:
    # plotly heeds limits of the colours as a pair only.
    limits = {"zmin": 0.0, "zmax": max(float(found.cost.max()), 1e-3)}
    bar = {"title": "mean cost", "x": 1.12}
    x, y, z = found.first, found.second, found.cost.T
    return go.Heatmap(x=x, y=y, z=z, colorscale="Greys", colorbar=bar, **limits)


def grip_chart(forces: Forces, scene: Scene) -> go.Figure:
    """Normal force of each finger on the object, and the palm's force, over time.

    Args:
      forces: Forces of a grasp, arrays of shape (time, ...).
    """
    figure = go.Figure()
    time = scene.discretization.timestep * np.arange(len(forces.grip))
    series = {f"finger {i}": forces.grip[:, i] for i in range(forces.grip.shape[1])}
    series["palm"] = np.linalg.norm(forces.palm, axis=1)
    for name, force in series.items():
        figure.add_scatter(x=time, y=force, mode="lines", name=name, line={"width": 1.5})
    for name, end in scene.phase_ends.items():
        figure.add_vline(end, line={"dash": "dot", "width": 1}, annotation_text=f"end of {name}")
    figure.update_layout(xaxis_title="time [s]", yaxis_title="force [N]", height=320, **_LAYOUT)
    return figure


def failure_chart(status: np.ndarray) -> go.Figure:
    """How often each cause of failure occurs in each episode.

    Args:
      status: Bits of `Status`, shape (episode, particle, trial).
    """
    number, figure = np.arange(1, len(status) + 1), go.Figure()
    for bit in (b for b in Status if b and b not in WARNINGS):
        count = ((status & bit) != 0).sum((1, 2))
        if count.any():
            figure.add_bar(x=number, y=count, name=bit.name)
    figure.update_layout(barmode="stack", height=300, showlegend=True, **_LAYOUT)
    figure.update_layout(xaxis_title="episode", yaxis_title="trials")
    figure.update_xaxes(dtick=_step(len(status)))
    return figure


def _step(episodes: int) -> int:
    rough = max(episodes / 10, 1)
    steps = (digit * 10**power for power in itertools.count() for digit in (1, 2, 5))
    return next(step for step in steps if step >= rough)
