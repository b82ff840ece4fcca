# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Pictures of maps, side by side, and of costs against iterations.

In: positions, pairs of keyframes, costs. Out: a .png, .svg or .pdf file. Colours are those of
Okabe and Ito, which people who see red and green alike can tell apart.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter
from matplotlib.transforms import ScaledTranslation
from numpy.typing import NDArray

from l1slam_ros.core.errors import FileError
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.io.files import counted, replacing, require_file
from l1slam_ros.io.ours import PROGRAM

_SUFFIXES = ('.png', '.svg', '.pdf')
_BLUE = '#0072B2'
_GREEN = '#009E73'
_ORANGE = '#E69F00'
_RED = '#D5370E'
_GREY = '#808080'
_PURPLE, _BLACK = '#CC79A7', '#000000'
_CURVE_COLOURS = (_BLUE, '#D55E00', _GREEN, _PURPLE, _ORANGE, '#56B4E9', _BLACK)
# What maps show, in the order of every legend; what the positions are comes last.
_ODOMETRY, _TRUTH, _LOOPS, _SUSPECT, _REFUSED, _FALSE = _LEGEND = (
    'odometry', 'truth', 'loops', 'suspect loops', 'refused loops', 'false loops')
# More loops than this make a picture slow and no clearer.
_MOST_LOOPS = 20_000
# The view follows odometry astray by no more than this part of the map's size.
_ASTRAY = 0.4
# Below this ratio of highest to lowest cost, an axis of powers of ten gets ticks in between.
_FEW_DECADES = 1e3
_PANEL = 5.6  # [inch]
# Lowest and highest a diagram beside a map may be, of its width.
_ASPECTS = 0.6, 1.4
_DOTS_PER_INCH = 150
_POINT = 1 / 72  # [inch]
# Of black: cells of a grid of which nothing is known, and those that are occupied.
_UNKNOWN, _WALL = 0.12, 0.75
# [inch] From the x axis down to the legend of a map: ticks, their numbers and the name of the axis
# are in between, and as high in every map, however flat that is.
_LEGEND_BELOW = 38 * _POINT


def _no_pairs() -> Indices:
    return np.zeros((0, 2), np.int64)


@dataclass(frozen=True)
class Ground:
    """
    An occupancy grid under a map.

    occupancy : (a, b) int8, column of x and row of y: 100 occupied, 0 free, -1 unknown; origin :
    (2,) the corner of cell (0, 0) [m]; resolution : [m]
    """

    occupancy: NDArray[np.int8]
    origin: Array
    resolution: float


@dataclass(frozen=True)
class MapDrawing:
    """
    The content of one map, by default seen from above.

    positions, odometry : (n, 2 or 3) [m]; truth : (l, 2 or 3) [m] a path, interrupted by rows of
    NaN; loops, suspect, rejected, false : (m, 2) pairs of rows of `positions`, each loop in one of
    these arrays; `false` has the loops known to be false that were not rejected; name : of the
    positions, in the legend; note : text under the title, e.g. costs; upwards : the axis that
    points up; ground : an occupancy grid under the map.
    """

    title: str
    positions: Array
    odometry: Array | None = None
    truth: Array | None = None
    loops: Indices = field(default_factory=_no_pairs)
    suspect: Indices = field(default_factory=_no_pairs)
    rejected: Indices = field(default_factory=_no_pairs)
    false: Indices = field(default_factory=_no_pairs)
    name: str = 'optimised'
    note: str = ''
    upwards: str = 'y'
    ground: Ground | None = None

    def views(self) -> 'list[MapDrawing]':
        """Return what is drawn: the map from above, and where it has heights, from the side."""
        if self.positions.shape[1] == 2:
            return [self]

        def aside(path: Array | None) -> Array | None:
            return None if path is None else path[:, [0, 2]]

        return [self, replace(
            self, title=f'{self.title}, from the side', positions=self.positions[:, [0, 2]],
            odometry=aside(self.odometry), truth=aside(self.truth), upwards='z')]


@dataclass(frozen=True)
class Curve:
    """One line of a diagram: costs (k,), above 0, after so many iterations (k,)."""

    label: str
    iterations: Array
    costs: Array


def check_picture(path: str | Path) -> None:
    """Refuse, before any work is done, a name that no picture can have."""
    if Path(path).suffix.lower() not in _SUFFIXES:
        raise FileError(path, f'unknown suffix; expected {", ".join(_SUFFIXES)}')
    require_file(path)


def plot_maps(path: str | Path, maps: Sequence[MapDrawing]) -> None:
    """
    Draw maps beside each other, in equal axes [m].

    Raises
    ------
    FileError : a suffix other than .png, .svg and .pdf, or a file that cannot be written.

    """
    views = [view for drawing in maps for view in drawing.views()]
    columns = len(views) if len(views) <= 3 else math.ceil(math.sqrt(len(views)))
    rows = math.ceil(len(views) / columns)
    figure = _new_figure(path, columns, rows)
    for k, drawing in enumerate(views, 1):
        _draw_map(figure.add_subplot(rows, columns, k), drawing)
    _save(figure, path)


def plot_curves(path: str | Path, curves: Sequence[Curve], title: str = '',
                names: tuple[str, str] = ('iteration', 'cost')) -> None:
    """
    Draw costs, on a logarithmic scale, against iterations; errors as for `plot_maps`.

    names : of the axes
    """
    figure = _new_figure(path, 1.3, 0.8)
    axes = figure.add_subplot()
    _draw_curves(axes, curves, title)
    axes.set_xlabel(names[0])
    axes.set_ylabel(names[1])
    _draw_legend(axes)
    _save(figure, path)


def plot_solution(path: str | Path, drawing: MapDrawing, curve: Curve, note: str) -> None:
    """Draw a map, and beside it the costs on the way, a note above; errors as for `plot_maps`."""
    views = drawing.views()
    columns = len(views) + 1
    figure = _new_figure(path, columns, 1)
    for k, view in enumerate(views, 1):
        beside = figure.add_subplot(1, columns, k)
        _draw_map(beside, view)
    axes = figure.add_subplot(1, columns, columns)
    _draw_curves(axes, [curve], curve.label, note)
    # As high as the map, unless that is a long corridor.
    (left, right), (low, high) = beside.get_xlim(), beside.get_ylim()
    axes.set_box_aspect(float(np.clip((high - low) / (right - left), *_ASPECTS)))
    _save(figure, path)


def _new_figure(path: str | Path, columns: float, rows: float) -> Figure:
    """Return an empty figure, after a look at the name it will have."""
    check_picture(path)
    return Figure(figsize=(_PANEL * columns, _PANEL * rows), dpi=_DOTS_PER_INCH,
                  layout='constrained')


def _save(figure: Figure, path: str | Path) -> None:
    with replacing(path) as temporary:
        kind = Path(path).suffix[1:].lower()
        # The mark that lets it be replaced; see `ours`.
        figure.savefig(temporary, format=kind, bbox_inches='tight', pad_inches=0.15,
                       metadata={'Software' if kind == 'png' else 'Creator': PROGRAM})


def _draw_curves(axes: Axes, curves: Sequence[Curve], title: str, note: str = '') -> None:
    for curve, colour in zip(curves, cycle(_CURVE_COLOURS), strict=False):
        axes.plot(curve.iterations, curve.costs, label=curve.label, linewidth=1.6, color=colour)
    if any((curve.costs > 0).any() for curve in curves):
        axes.set_yscale('log')
    low, high = axes.get_ylim()
    if high < _FEW_DECADES * low:
        # Powers of ten alone would be hardly any ticks at all.
        axes.yaxis.set_major_locator(
            LogLocator(subs=(1.0, 2.0, 5.0)) if high > 10 * low else MaxNLocator(6))
        axes.yaxis.set_major_formatter(StrMethodFormatter('{x:g}'))
        axes.yaxis.set_minor_formatter(NullFormatter())
    axes.margins(0.06, 0.08)
    axes.set_xlim(right=max(1.0, axes.get_xlim()[1]))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    _write_title(axes, title, note)
    axes.set_xlabel('iteration')
    axes.set_ylabel('cost')
    _tidy(axes)


def _write_title(axes: Axes, title: str, small_print: str) -> None:
    """Write above a diagram, where nothing is drawn."""
    # The name of a file may hold a dollar, or bytes that are no text.
    axes.set_title(title.encode(errors='replace').decode(), loc='left', fontweight='bold',
                   pad=24 if small_print else None, parse_math=False)
    axes.annotate(small_print, (0, 1), (0, 7), xycoords='axes fraction',
                  textcoords='offset points', color='#555555', fontsize='small')


def _draw_map(axes: Axes, drawing: MapDrawing) -> None:
    """Draw, from bottom to top, the loops, the truth, the refused loops and the positions."""
    if drawing.ground is not None:
        _draw_ground(axes, drawing.ground)
    if drawing.odometry is not None:
        _draw_path(axes, drawing.odometry, _ODOMETRY, _GREY, 0.7, zorder=1,
                   opacity=_opacity(len(drawing.odometry)))
    if drawing.truth is not None:
        _draw_path(axes, drawing.truth, _TRUTH, _ORANGE, 2.8, zorder=2)
    # Lines right across the map are under it, and the fainter the more there are.
    for pairs, label, colour in ((drawing.suspect, _SUSPECT, _PURPLE),
                                 (drawing.rejected, _REFUSED, _RED),
                                 (drawing.false, _FALSE, _BLACK)):
        _draw_pairs(axes, drawing.positions, pairs, label, colour, zorder=3,
                    opacity=float(np.clip(50 / max(len(pairs), 1), 0.08, 0.8)))
    _draw_pairs(axes, drawing.positions, drawing.loops, _LOOPS, _GREEN, zorder=4,
                opacity=_opacity(len(drawing.loops)))
    _draw_path(axes, drawing.positions, drawing.name, _BLUE, 1.0, zorder=5)
    axes.plot(*drawing.positions[0, :2], 'o', color=_BLUE, markersize=5, zorder=6)
    _write_title(axes, drawing.title, _small_print(drawing))
    _set_view(axes, drawing)
    axes.set_xlabel('x [m]')
    axes.set_ylabel(f'{drawing.upwards} [m]')
    _tidy(axes)
    _draw_legend(axes)


def _draw_ground(axes: Axes, ground: Ground) -> None:
    """Draw what is occupied dark, what is free white, and what is unknown light grey."""
    shade = np.where(ground.occupancy < 0, _UNKNOWN, np.where(ground.occupancy > 0, _WALL, 0.0))
    x, y = ground.origin
    a, b = ground.resolution * np.array(ground.occupancy.shape)
    axes.imshow(shade.T, 'Greys', origin='lower', extent=(x, x + a, y, y + b), vmin=0, vmax=1,
                zorder=0)


def _draw_legend(axes: Axes) -> None:
    """Draw the legend below a diagram and the name of its x axis, always in the same order."""
    handles, labels = axes.get_legend_handles_labels()
    shown = dict(zip(labels, handles, strict=True))
    order = [*(label for label in _LEGEND if label in shown),
             *(label for label in shown if label not in _LEGEND)]
    below = ScaledTranslation(0, -_LEGEND_BELOW, axes.figure.dpi_scale_trans)
    # Matplotlib fills column by column; people read row by row.
    columns = 5 if len(order) <= 5 else 4
    order = [label for k in range(columns) for label in order[k::columns]]
    axes.legend([shown[label] for label in order], order, loc='upper center',
                bbox_to_anchor=(0.5, 0), borderaxespad=0, bbox_transform=axes.transAxes + below,
                ncols=columns, frameon=False, fontsize='small',
                columnspacing=1.4, handlelength=1.4)


def _small_print(drawing: MapDrawing) -> str:
    kinds = {'refused': drawing.rejected, 'suspect': drawing.suspect, 'false': drawing.false}
    parts = [f'{len(pairs):,} {word}' for word, pairs in kinds.items() if len(pairs)]
    if len(drawing.loops) > _MOST_LOOPS:
        parts.append(f'{_MOST_LOOPS:,} drawn')
    loops = len(drawing.loops) + sum(map(len, kinds.values()))
    said = f'{counted(len(drawing.positions), "pose")}, {counted(loops, "loop")}'
    return (said + (f' ({", ".join(parts)})' if parts else '')
            + (f'; {drawing.note}' if drawing.note else ''))


def _draw_path(
    axes: Axes, positions: Array, label: str, colour: str, width: float, zorder: int,
    opacity: float = 1.0,
) -> None:
    axes.plot(positions[:, 0], positions[:, 1], color=colour, linewidth=width, label=label,
              zorder=zorder, alpha=opacity, solid_joinstyle='round')


def _draw_pairs(
    axes: Axes, positions: Array, pairs: Indices, label: str, colour: str, zorder: int,
    opacity: float,
) -> None:
    """Draw loops as lines between the positions they join, evenly thinned out if too many."""
    if not len(pairs):
        return
    count = min(len(pairs), _MOST_LOOPS)
    shown = pairs[np.linspace(0, len(pairs) - 1, count).astype(np.int64)]
    # Without `rasterized` an .svg or .pdf of a large graph takes minutes to open.
    axes.add_collection(LineCollection(list(positions[shown][:, :, :2]), colors=colour,
                                       linewidths=0.8, alpha=opacity, zorder=zorder,
                                       rasterized=True), autolim=False)
    axes.plot([], [], color=colour, linewidth=1.2, label=label)


def _opacity(count: int) -> float:
    """Return a fainter opacity the more lines there are, so that none drowns the others."""
    return float(np.clip(25 / math.sqrt(max(count, 1)), 0.3, 0.8))


def _set_view(axes: Axes, drawing: MapDrawing) -> None:
    """Show the whole map and truth, and the odometry as far as it stays near them."""
    seen = [drawing.positions] if drawing.truth is None else [drawing.positions, drawing.truth]
    points = np.concatenate([positions[:, :2] for positions in seen])
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    size = max(float((high - low).max()), 1.0)
    if (ground := drawing.ground) is not None:
        end = ground.origin + ground.resolution * np.array(ground.occupancy.shape)
        low = np.minimum(low, ground.origin)
        high = np.maximum(high, end)
    if drawing.odometry is not None:
        strayed = drawing.odometry[:, :2].clip(low - _ASTRAY * size, high + _ASTRAY * size)
        low, high = np.minimum(low, strayed.min(axis=0)), np.maximum(high, strayed.max(axis=0))
    margin = 0.04 * size
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - margin, high[1] + margin)
    axes.set_aspect('equal')
    # Below a map so narrow that two numbers would lie over each other, one has to do.
    axes.xaxis.set_major_locator(MaxNLocator('auto', steps=[1, 2, 2.5, 5, 10], min_n_ticks=1))


def _tidy(axes: Axes) -> None:
    axes.grid(True, color='#DDDDDD', linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[['top', 'right']].set_visible(False)
