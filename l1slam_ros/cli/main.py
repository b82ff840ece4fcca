# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`l1slam`: the core from the command line, without ROS. Parsing, and the exit code."""

import argparse
import math
import os
import signal
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from l1slam_ros.cli.fleet_options import add_batch, add_merge
from l1slam_ros.core import names
from l1slam_ros.core.errors import L1SlamError, optional_libraries
from l1slam_ros.io.bags.topics import DEFAULT_TOPICS
from l1slam_ros.io.progress import forget, say
from l1slam_ros.paper import printed as paper

BAD_INPUT = 2
READ_IN_PART = 3
DOUBTFUL = 4
INTERRUPTED = 130
BROKEN_PIPE = 141
_INPUT = ('a graph (.g2o, TORO .graph or .toro, .jrl, .cbor), a bag (rosbag2 directory, .mcap, '
          '.db3, .bag of ROS 1) or a CARMEN log with laser scans (.clf, .log); graphs and logs '
          'also packed: .bz2, .gz')
_WORD = ('files beside a graph may vouch for loops (INPUT.trusted.txt) and strike loops out '
         '(INPUT.struck.txt), by lines `i j` of vertex ids')
_OUTPUT = '.g2o, .jrl, .cbor, .tum, or a name without a suffix for a bag directory'
_GRAPH_OUTPUT = '.g2o, .jrl, .cbor, or a name without a suffix for a bag directory'
_KIND = ('what a false loop measures. random: a small relative pose between two poses that are '
         'far apart; identity: the zero pose between two such poses; grouped: 10 to 20 '
         'consecutive loops that agree with each other (default: %(default)s)')
_FIRST_STEPS = """\
a first look:
  l1slam simulate world.g2o --poses 1000 --edges 2000
  l1slam solve world.g2o --reference world.g2o.truth.txt --plot map.png
"""
_MORE = """\
`l1slam COMMAND --help` explains one command.

exit codes:
  0  done
  2  bad input or arguments: one line says what is wrong, and nothing is written
  3  done, but only a part of the input was used: the file is damaged, or a bag has loops that did
     not get into the map (most were refused, or no topic with loops was read); batch: some
     recordings failed or were used only in part
  4  solve, merge: the best map is written, but it is doubtful (4 also where 3 would apply)

To complete commands and options with the TAB key in bash and zsh, install argcomplete
(pip install argcomplete, or the package python3-argcomplete) and run:
  eval "$(register-python-argcomplete l1slam)"
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return the exit code, see `l1slam --help`."""
    try:
        if arguments is None:  # a process of our own, which is to leave nothing half written
            signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            return _answer(arguments)
        finally:
            # Here, where it can be answered: at the end of Python a failure is but noise.
            if sys.stdout is not None:
                sys.stdout.flush()
    except BrokenPipeError:
        forget(sys.stdout)
        return BROKEN_PIPE
    except OSError as error:
        forget(sys.stdout)
        what = error.strerror or str(error)
        return _refuse(what if error.filename is None else f'{error.filename}: {what}')
    except L1SlamError as error:
        return _refuse(str(error))
    except MemoryError:
        return _refuse('not enough memory for a graph of this size')
    except KeyboardInterrupt:
        return INTERRUPTED


def _answer(arguments: Sequence[str] | None) -> int:
    parser = _parser()
    if '_ARGCOMPLETE' in os.environ:
        import argcomplete

        argcomplete.autocomplete(parser)
    options = parser.parse_args(arguments)
    if options.version:
        from l1slam_ros.cli.version import version_text

        print(version_text())
        return 0
    if options.command is None:
        parser.print_help(sys.stderr)
        return BAD_INPUT
    ending = _run(options)
    for sentence in filter(None, ending):
        say(sentence)
    if ending.doubt:
        return DOUBTFUL
    return READ_IN_PART if ending.damage else 0


def _run(options: argparse.Namespace) -> Any:
    # That of a notebook, which its children get too, may not be installed here.
    os.environ.pop('MPLBACKEND', None)
    import numpy as np

    # Numbers beyond all measure end in an error that says so, not in NumPy's warnings.
    with np.errstate(all='ignore'), optional_libraries():
        module = import_module(f'l1slam_ros.cli.{_COMMANDS[options.command][0]}')
        return getattr(module, options.command)(options)


def _refuse(sentence: str) -> int:
    say(sentence)
    return BAD_INPUT


def _add_force(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--force', action='store_true',
                        help='replace an existing output even if l1slam did not write it; a '
                        'folder that is no bag is kept beside it, under the time of its last '
                        'change; an input is never replaced')


def _add_reading(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group('options for graph files and for bags').add_argument
    add('--rotation-information', choices=names.ROTATION_INFORMATION,
        default=names.ROTATION_INFORMATION[0],
        help='3D g2o files, read and written: the rotation block of the information is that of '
        "the quaternion's vector part, as in g2o, or that of the angle (default: %(default)s)")
    add('--information', type=_information, metavar='X',
        help='graph files: the information, X on its diagonal, of factors that state none; '
        'without it such a file is refused')
    for name, default, what in (
        ('odom', DEFAULT_TOPICS.odometry, 'a topic of nav_msgs/Odometry; or a topic with the pose '
         'graph of another front end, which is then taken whole: rtabmap_msgs/MapGraph, '
         'pose_graph_tools_msgs/PoseGraph, slam_toolbox/PoseGraph, '
         'cslam_common_interfaces/KeyframeOdom'),
        ('loop', DEFAULT_TOPICS.loops, 'a topic of geometry_msgs/PoseWithCovarianceStamped; or a '
         'topic with such a pose graph, of which only the loops are taken'),
    ):
        add(f'--{name}-topic', default=default, metavar='TOPIC',
            help=f'bags: {what} (default: %(default)s)')
    add('--params-file', type=Path, metavar='YAML',
        help="the node's parameter file: its keyframe, noise and solver parameters are used here, "
        'too. A bag written by l1slam says itself what its messages are; that replaces defaults, '
        'not what the file sets')


def _information(text: str) -> float:
    """Return the number above 0 that a text is."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f'{text!r}; expected a number above 0')
    return value


def _add_solve(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('input', type=Path, metavar='INPUT', help=f'{_INPUT}; {_WORD}')
    add('--start', choices=names.STARTS, default=names.STARTS[0],
        help='the poses to start from. seed: computed from the graph alone; file: the poses '
        'stored in INPUT; odometry: the odometry chained up. A robust solve always starts from '
        'its own seed (default: %(default)s)')
    add('--norm', choices=names.NORMS,
        help='the norm to minimise. l1: sum of the absolute values of all residual components; '
        'group-l1: sum of the lengths of the residuals, independent of the axes they are written '
        'in; l2; huber (default: solver.norm of --params-file, or l1)')
    add('--loop-norm', choices=(names.SAME, *names.NORMS),
        help='the norm for loops and absolute poses (default: solver.loop_norm of --params-file, '
        'or the same norm as the odometry)')
    add('--solver', choices=names.SOLVERS, default=names.SOLVERS[0],
        help='solver for --norm l1; auto takes interior-point for sparse graphs and primal-dual '
        'for dense ones (default: %(default)s)')
    add('--robust', action=argparse.BooleanOptionalAction,
        help='--robust: judge the loops, refuse false ones and list them; --no-robust: use all '
        'loops (default: judge them, unless the odometry has too many gaps to judge by)')
    add('--outer', type=int, metavar='N', help='largest number of linearisations')
    add('--inner', type=int, metavar='N',
        help='largest number of primal-dual iterations for each linearisation')
    add('--scans', metavar='TOPIC',
        help='bags: build the graph from the laser scans on this topic and the odometry on '
        '--odom-topic; a CARMEN log needs no such option')
    _add_results(parser)
    _add_reading(parser)


def _add_results(parser: argparse.ArgumentParser) -> None:
    """Add the options of `solve` on what is written and printed."""
    add = parser.add_argument
    add('--output', type=Path, metavar='OUT', help=f'write the map: {_OUTPUT}')
    add('--reference', metavar='TRUTH',
        help='print the position error with respect to true poses: a TUM, g2o or .jrl file, text '
        'of lines `id x y theta`, CSV of `stamp, x, y, theta`, or a topic of a bag as BAG:/TOPIC '
        '(the word `bag` stands for INPUT); stamped poses are interpolated')
    add('--plot', type=Path, metavar='PNG', help='draw the map and the cost: .png, .svg or .pdf')
    add('--grid', type=Path, metavar='PGM',
        help='write the occupancy grid of the scans as .pgm and .yaml for the map server of nav2')
    add('--report', type=Path, metavar='HTML',
        help='write a web page with the map and, for each loop, its state and the reason; it also '
        'makes the lines that vouch for a loop or strike it out. Needs plotly')
    _add_force(parser)
    add('--json', action='store_true', help='print one JSON object on standard output')
    add('--quiet', action='store_true', help='print no progress, no summary and no warnings')


def _add_batch(parser: argparse.ArgumentParser) -> None:
    add_batch(parser)
    _add_reading(parser)


def _add_merge(parser: argparse.ArgumentParser) -> None:
    add_merge(parser)
    _add_reading(parser)


def _add_convert(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('input', type=Path, metavar='INPUT', help=_INPUT)
    parser.add_argument('output', type=Path, metavar='OUTPUT', help=_OUTPUT)
    _add_force(parser)
    _add_reading(parser)


def _add_simulate(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('output', type=Path, metavar='OUTPUT',
        help=f'{_GRAPH_OUTPUT}; the true poses are written to OUTPUT.truth.txt, the false loops '
        'to OUTPUT.false.txt')
    add('--world', choices=names.WORLDS, default=names.WORLDS[0],
        help='streets: in the plane; in space: a building with several floors and ramps, or a '
        'drive on a sphere or a torus (default: %(default)s)')
    add('--poses', type=int, required=True, metavar='N', help='number of poses')
    add('--edges', type=int, required=True, metavar='M',
        help='number of true edges, those of the odometry included')
    add('--false-loops', type=int, default=0, metavar='K',
        help='number of false loops, added to the M edges (default: %(default)s)')
    add('--scans', action='store_true',
        help='also put houses along the streets and write what a laser sees of them to /scan; '
        'OUTPUT must be a bag')
    _add_randomness(parser)


def _add_corrupt(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('input', type=Path, metavar='INPUT', help=_INPUT)
    add('output', type=Path, metavar='OUTPUT',
        help=f'{_GRAPH_OUTPUT}; the vertex ids of the false loops are written to '
        'OUTPUT.false.txt')
    add('--false-loops', type=int, required=True, metavar='K', help='number of false loops')
    _add_randomness(parser)
    _add_reading(parser)


def _add_randomness(parser: argparse.ArgumentParser) -> None:
    _add_force(parser)
    parser.add_argument('--kind', choices=names.KINDS_OF_FALSE_LOOPS,
                        default=names.KINDS_OF_FALSE_LOOPS[0], help=_KIND)
    parser.add_argument('--seed', type=int, default=0, metavar='S',
                        help='seed of the random numbers (default: %(default)s)')


def _add_info(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('input', type=Path, metavar='INPUT', help=_INPUT)
    _add_reading(parser)


def _add_plot(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('input', type=Path, nargs='+', metavar='INPUT',
                        help=f'{_INPUT}; INPUT.truth.txt and INPUT.false.txt are drawn, too, if '
                        'they exist')
    parser.add_argument('--output', type=Path, required=True, metavar='PNG',
                        help='.png, .svg or .pdf')
    _add_force(parser)
    _add_reading(parser)


def _add_reproduce(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('--datasets', type=Path, metavar='DIR',
        help=f"folder with the paper's own graphs: {', '.join(paper.FILES)}; "
        'without it only the simulated worlds are used')
    add('--worlds', choices=list(paper.WORLDS), default='all',
        help="which of the paper's large worlds to simulate. 10k: 10,000 poses with 64,000 edges; "
        'all: also 50,000 poses with 700,000 edges, which takes minutes (default: %(default)s)')
    add('--output', type=Path, default=Path('reproduction'), metavar='DIR',
        help='folder for report.md and its pictures (default: %(default)s)')
    _add_force(parser)


# Command -> the module that runs it (imported only then), what it does, an example, its options.
_COMMANDS: dict[str, tuple[str, str, str, Callable[[argparse.ArgumentParser], None]]] = {
    'solve': ('solving', 'optimise a graph or a bag',
              'graph.g2o --output solved.g2o --plot map.png', _add_solve),
    'merge': ('merging', 'make one map from several drives or robots',
              'monday.g2o tuesday.mcap --loops between.txt --output both.g2o', _add_merge),
    'batch': ('batching', 'solve each recording of a folder, on all cores or on a cluster',
              'recordings --output results', _add_batch),
    'convert': ('commands', 'convert between graph files and bags', 'graph.g2o bag',
                _add_convert),
    'simulate': ('worlds', 'simulate a graph with known true poses',
                 'world.g2o --poses 1000 --edges 2000 --seed 1', _add_simulate),
    'corrupt': ('worlds', 'add false loops to a graph',
                'graph.g2o spoiled.g2o --false-loops 20 --kind grouped', _add_corrupt),
    'info': ('commands', 'print what a graph or a bag holds, and what looks wrong', 'graph.g2o',
             _add_info),
    'plot': ('drawing', 'draw maps side by side; loops known to be false are black',
             'graph.g2o solved.g2o --output maps.png', _add_plot),
    'reproduce': ('reproducing',
                  "run the paper's experiments and report the results beside the paper's",
                  '--datasets datasets --worlds 10k --output reproduction', _add_reproduce)}


def _parser() -> argparse.ArgumentParser:
    as_written = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        prog='l1slam', description='Pose-graph SLAM with the L1 norm, from files, without ROS.',
        epilog=f'{_FIRST_STEPS}\n{_MORE}', formatter_class=as_written)
    parser.add_argument('--version', action='store_true', help='print the version and end')
    commands_of = parser.add_subparsers(metavar='COMMAND', dest='command')
    for name, (_, text, example, add_options) in _COMMANDS.items():
        add_options(commands_of.add_parser(
            name, help=text, description=f'{text[0].upper()}{text[1:]}.',
            epilog=f'example:\n  l1slam {name} {example}', formatter_class=as_written))
    return parser
