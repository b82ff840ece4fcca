# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`l1slam`: the core from the command line, without ROS. Parsing, and the exit code."""
# PYTHON_ARGCOMPLETE_OK

import argparse
import os
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from l1slam_ros.cli.fleet_options import add_batch, add_merge
from l1slam_ros.core import names
from l1slam_ros.core.errors import L1SlamError, optional_libraries
from l1slam_ros.io.bags.topics import DEFAULT_TOPICS
from l1slam_ros.io.progress import say
from l1slam_ros.paper import printed as paper

BAD_INPUT = 2
READ_IN_PART = 3
DOUBTFUL = 4
INTERRUPTED = 130
BROKEN_PIPE = 141
_INPUT = ('.g2o, TORO .graph, .jrl or its .cbor, a rosbag2 directory, .mcap, .db3, .bag of ROS 1, '
          'or a CARMEN log with scans: .clf, .log, .bz2, .gz')
_WORD = ('beside a graph INPUT.trusted.txt and INPUT.struck.txt, lines `i j` of vertex ids, may '
         'vouch for loops and strike loops out')
_OUTPUT = '.g2o, .jrl or its .cbor, .tum, or a name without a suffix for a bag directory'
_GRAPH_OUTPUT = '.g2o, .jrl or its .cbor, or a name without a suffix for a bag directory'
_KIND = ('random: far poses said to be near each other; identity: at the very same place; '
         'grouped: 10 to 20 in a row that agree (default: %(default)s)')
_FIRST_STEPS = """\
a first look:
  l1slam simulate world.g2o --poses 1000 --edges 2000
  l1slam solve world.g2o --reference world.g2o.truth.txt --plot map.png
"""
_MORE = """\
`l1slam COMMAND --help` explains one command.

exit codes:
  0  done
  2  bad input or arguments, said in one line; nothing written
  3  done, but only a part of the input was used: it is damaged, or the loops of a bag did not get
     in, because most were refused or none of their topics was read; batch: some recordings failed
     or were used only in part
  4  solve, merge: the best map is written, but it is doubtful (also where the code would be 3)

completion of commands and options by the TAB key, in bash and zsh, where argcomplete is
installed (pip install argcomplete, or the package python3-argcomplete):
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
        _forget_output()
        return BROKEN_PIPE
    except OSError as error:
        _forget_output()
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


def _forget_output() -> None:
    """Let Python not fail again on what nobody can read when it ends."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _add_force(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--force', action='store_true',
                        help='replace what is there, though l1slam did not write it; an input '
                        'is never replaced')


def _add_reading(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group('how to read a 3D g2o file, or a bag').add_argument
    add('--rotation-information', choices=names.ROTATION_INFORMATION,
        default=names.ROTATION_INFORMATION[0],
        help="in and out: what the information's rotation block is of, the vector part of the "
        'quaternion, as g2o has it, or the angle (default: %(default)s)')
    for name, default, what in (
        ('odom', DEFAULT_TOPICS.odometry, 'nav_msgs/Odometry; or, as a whole, the pose graph of '
         'an rtabmap_msgs/MapGraph, pose_graph_tools_msgs/PoseGraph, slam_toolbox/PoseGraph or '
         'cslam_common_interfaces/KeyframeOdom'),
        ('loop', DEFAULT_TOPICS.loops, 'geometry_msgs/PoseWithCovarianceStamped, or the loops of '
         'such a pose graph'),
    ):
        add(f'--{name}-topic', default=default, metavar='TOPIC',
            help=f'{what} (default: %(default)s)')
    add('--params-file', type=Path, metavar='YAML',
        help="the node's parameter file: what makes keyframes, their noise, and the solver; what "
        'a bag of l1slam notes of itself comes before defaults')


def _add_solve(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('input', type=Path, metavar='INPUT', help=f'{_INPUT}; {_WORD}')
    add('--start', choices=names.STARTS, default=names.STARTS[0],
        help='where from: first poses from the graph alone, the stored poses, or the odometry; '
        'where loops are doubted, always from the graph alone (default: %(default)s)')
    add('--norm', choices=names.NORMS,
        help='what is minimised: l1, of each component; group-l1, of the length of each factor, '
        'whatever axes it is written in; l2; huber (default: as of solver.norm, l1)')
    add('--loop-norm', choices=(names.SAME, *names.NORMS),
        help='what is minimised of loops and absolute poses (default: as of solver.loop_norm, '
        'same)')
    add('--solver', choices=names.SOLVERS, default=names.SOLVERS[0],
        help='for l1; auto: interior-point on sparse graphs (default: %(default)s)')
    add('--robust', action=argparse.BooleanOptionalAction,
        help='refuse loops that cannot be believed, and say which, or believe all; by default '
        'they are doubted wherever they can be judged')
    add('--outer', type=int, metavar='N', help='most linearisations')
    add('--inner', type=int, metavar='N', help='most primal-dual iterations of each')
    add('--output', type=Path, metavar='OUT', help=_OUTPUT)
    add('--reference', metavar='TRUTH',
        help='print the position error to it: TUM, g2o, .jrl, `id x y theta` text, CSV of '
        "`stamp, x, y, theta`, or a bag's topic, BAG:/TOPIC, where `bag` is INPUT; interpolated "
        'at the stamps of the poses')
    add('--plot', type=Path, metavar='PNG', help='draw the map and its cost; .svg and .pdf too')
    add('--scans', metavar='TOPIC',
        help='of a bag: make the graph of the laser scans on this topic and of --odom-topic; a '
        'CARMEN log needs none')
    add('--grid', type=Path, metavar='PGM',
        help='write the occupancy grid of the scans, with its .yaml, as the map server of nav2 '
        'reads them')
    add('--report', type=Path, metavar='HTML',
        help='write a page that shows each loop, its fate and why, and lets one settle a doubt; '
        'needs plotly')
    _add_force(parser)
    add('--json', action='store_true', help='one object on standard output')
    add('--quiet', action='store_true', help='no progress, no summary, no warning')
    _add_reading(parser)


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
        help=f'{_GRAPH_OUTPUT}; beside it OUTPUT.truth.txt and OUTPUT.false.txt')
    add('--world', choices=names.WORLDS, default=names.WORLDS[0],
        help='streets in the plane; in space a building of several floors, with ramps, or a drive '
        'on a sphere or a torus (default: %(default)s)')
    add('--poses', type=int, required=True, metavar='N')
    add('--edges', type=int, required=True, metavar='M', help='true ones, odometry included')
    add('--false-loops', type=int, default=0, metavar='K',
        help='on top of the edges (default: %(default)s)')
    add('--scans', action='store_true',
        help='houses along the streets, and what a laser sees of them on /scan; OUTPUT is a bag')
    _add_randomness(parser)


def _add_corrupt(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('input', type=Path, metavar='INPUT', help=_INPUT)
    add('output', type=Path, metavar='OUTPUT',
        help=f'{_GRAPH_OUTPUT}; beside it OUTPUT.false.txt, the vertex ids of the false loops')
    add('--false-loops', type=int, required=True, metavar='K', help='how many')
    _add_randomness(parser)
    _add_reading(parser)


def _add_randomness(parser: argparse.ArgumentParser) -> None:
    _add_force(parser)
    parser.add_argument('--kind', choices=names.KINDS_OF_FALSE_LOOPS,
                        default=names.KINDS_OF_FALSE_LOOPS[0], help=_KIND)
    parser.add_argument('--seed', type=int, default=0, metavar='S',
                        help='another one, another draw (default: %(default)s)')


def _add_info(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('input', type=Path, metavar='INPUT', help=_INPUT)
    _add_reading(parser)


def _add_plot(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('input', type=Path, nargs='+', metavar='INPUT',
                        help=f'{_INPUT}; INPUT.truth.txt and INPUT.false.txt are drawn, if there')
    parser.add_argument('--output', type=Path, required=True, metavar='PNG',
                        help='.png, .svg or .pdf')
    _add_force(parser)
    _add_reading(parser)


def _add_reproduce(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('--datasets', type=Path, metavar='DIR',
        help=f"the folder with the paper's own graphs: {', '.join(paper.FILES)}; "
        'without it, the simulated worlds alone')
    add('--worlds', choices=list(paper.WORLDS), default='all',
        help="which of the paper's large worlds to simulate: 10,000 poses with 64,000 edges, and "
        '50,000 with 700,000, which takes minutes (default: %(default)s)')
    add('--output', type=Path, default=Path('reproduction'), metavar='DIR',
        help='the folder for report.md and its pictures (default: %(default)s)')
    _add_force(parser)


# By name: the module that runs a command, imported only then; what it does; an example; options.
_COMMANDS: dict[str, tuple[str, str, str, Callable[[argparse.ArgumentParser], None]]] = {
    'solve': ('solving', 'optimise a graph or a bag',
              'graph.g2o --output solved.g2o --plot map.png', _add_solve),
    'merge': ('merging', 'make one map of several drives or robots',
              'monday.g2o tuesday.mcap --loops between.txt --output both.g2o', _add_merge),
    'batch': ('batching', 'solve each recording of a folder, on all cores or on a cluster',
              'recordings --output results', _add_batch),
    'convert': ('commands', 'turn a graph file into a bag, or back', 'graph.g2o bag',
                _add_convert),
    'simulate': ('worlds', 'make a world, its truth known',
                 'world.g2o --poses 1000 --edges 2000 --seed 1', _add_simulate),
    'corrupt': ('worlds', 'add false loops to a graph',
                'graph.g2o spoiled.g2o --false-loops 20 --kind grouped', _add_corrupt),
    'info': ('commands', 'say what is in a graph or a bag, and what looks wrong', 'graph.g2o',
             _add_info),
    'plot': ('drawing', 'draw maps beside each other, known false loops black',
             'graph.g2o solved.g2o --output maps.png', _add_plot),
    'reproduce': ('reproducing',
                  "run the paper's experiments and report them beside what it printed",
                  '--datasets datasets --worlds 10k --output reproduction', _add_reproduce)}


def _parser() -> argparse.ArgumentParser:
    as_written = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        prog='l1slam', description='Pose-graph SLAM by the L1 norm, from files; needs no ROS.',
        epilog=f'{_FIRST_STEPS}\n{_MORE}', formatter_class=as_written)
    parser.add_argument('--version', action='store_true', help='print the version and end')
    commands_of = parser.add_subparsers(metavar='COMMAND', dest='command')
    for name, (_, text, example, add_options) in _COMMANDS.items():
        add_options(commands_of.add_parser(
            name, help=text, description=f'{text[0].upper()}{text[1:]}.',
            epilog=f'example:\n  l1slam {name} {example}', formatter_class=as_written))
    return parser
