# SPDX-License-Identifier: Apache-2.0
"""`l1slam`: the core from the command line, without ROS. Parsing, and the exit code."""

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from l1slam_ros import commands, offline, paper
from l1slam_ros.core.choice import SOLVERS
from l1slam_ros.core.errors import L1SlamError
from l1slam_ros.core.false_loops import FALSE_LOOPS
from l1slam_ros.graph_from_bag import DEFAULT_TOPICS

BAD_INPUT, READ_IN_PART, INTERRUPTED = 2, 3, 130

_INPUT = '.g2o, TORO .graph, a rosbag2 directory, .mcap, .db3, or .bag of ROS 1'
_OUTPUT = '.g2o, .graph, .tum, or a name without a suffix for a bag directory'
_GRAPH_OUTPUT = '.g2o, .graph, or a name without a suffix for a bag directory'
_KIND = ('random: far poses said to be near each other; identity: at the very same place; '
         'grouped: 10 to 20 in a row that agree (default: %(default)s)')
_FIRST_STEPS = """\
a first look:
  l1slam simulate world.g2o --poses 1000 --edges 2000
  l1slam solve world.g2o --reference world.g2o.truth.txt --plot map.png
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return the exit code: 0, 2 for bad input, 3 for input read in part."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.run is None:
        parser.print_help(sys.stderr)
        return BAD_INPUT
    try:
        # Numbers beyond all measure end in an error that says so, not in NumPy's warnings.
        with np.errstate(all='ignore'):
            damage = options.run(options)
    except (L1SlamError, OSError) as error:
        print(f'l1slam: {error}', file=sys.stderr)
        return BAD_INPUT
    except MemoryError:
        print('l1slam: not enough memory for a graph of this size', file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        return INTERRUPTED
    if damage:
        print(f'l1slam: {damage}', file=sys.stderr)
        return READ_IN_PART
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='l1slam', description='Pose-graph SLAM by the L1 norm, from files; needs no ROS.',
        epilog=_FIRST_STEPS + '\n`l1slam COMMAND --help` explains one command.',
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.set_defaults(run=None)
    commands_of = parser.add_subparsers(metavar='COMMAND')

    def add(name: str, run: Callable[[argparse.Namespace], str], text: str,
            example: str) -> argparse.ArgumentParser:
        command = commands_of.add_parser(
            name, help=text, description=f'{text[0].upper()}{text[1:]}.',
            epilog=f'example:\n  l1slam {name} {example}',
            formatter_class=argparse.RawDescriptionHelpFormatter)
        command.set_defaults(run=run)
        return command

    _add_solve(add('solve', commands.solve, 'optimise a graph or a bag',
                   'graph.g2o --output solved.g2o --plot map.png'))
    _add_convert(add('convert', commands.convert, 'turn a graph file into a bag, or back',
                     'graph.g2o bag'))
    _add_simulate(add('simulate', commands.simulate, 'make a world of streets, its truth known',
                      'world.g2o --poses 1000 --edges 2000 --seed 1'))
    _add_corrupt(add('corrupt', commands.corrupt, 'add false loops to a graph',
                     'graph.g2o spoiled.g2o --false-loops 20 --kind grouped'))
    _add_info(add('info', commands.info, 'say what is in a graph or a bag, and what looks wrong',
                  'graph.g2o'))
    _add_plot(add('plot', commands.plot, 'draw maps beside each other, false loops red',
                  'graph.g2o solved.g2o --output maps.png'))
    _add_reproduce(add('reproduce', commands.reproduce,
                       "run the paper's experiments and report them beside what it printed",
                       '--datasets datasets --worlds 10k --output reproduction'))
    return parser


def _add_input(parser: argparse.ArgumentParser) -> None:
    """Add the input, and how a bag of other origin is read."""
    parser.add_argument('input', type=Path, metavar='INPUT', help=_INPUT)
    _add_bag_options(parser)


def _add_bag_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group('how to read a bag').add_argument
    add('--odom-topic', default=DEFAULT_TOPICS.odometry, metavar='TOPIC',
        help='nav_msgs/Odometry (default: %(default)s)')
    add('--loop-topic', default=DEFAULT_TOPICS.loops, metavar='TOPIC',
        help='geometry_msgs/PoseWithCovarianceStamped (default: %(default)s)')
    add('--trusted-topic', default=DEFAULT_TOPICS.trusted, metavar='TOPIC',
        help='the same, loops somebody vouches for (default: %(default)s)')
    add('--params-file', type=Path, metavar='YAML',
        help="the node's parameter file: what makes keyframes, their noise, and the solver; "
        'without it, what a bag of l1slam notes of itself, or the defaults of the node')


def _add_solve(parser: argparse.ArgumentParser) -> None:
    _add_input(parser)
    add = parser.add_argument
    add('--start', choices=offline.STARTS, default=offline.STARTS[0],
        help='where from: first poses from the graph alone, the stored poses, or the odometry '
        '(default: %(default)s)')
    add('--norm', choices=offline.NORMS, default=offline.NORMS[0],
        help='what is minimised (default: %(default)s)')
    add('--solver', choices=SOLVERS, default=SOLVERS[0],
        help='for l1; auto: interior-point on sparse graphs (default: %(default)s)')
    add('--robust', action='store_true',
        help='refuse loops that cannot be believed, and say which')
    add('--outer', type=int, metavar='N', help='most linearisations')
    add('--inner', type=int, metavar='N', help='most primal-dual iterations of each')
    add('--output', type=Path, metavar='OUT', help=_OUTPUT)
    add('--reference', type=Path, metavar='TRUTH',
        help='print the position error to it: TUM, g2o or `id x y theta` text')
    add('--plot', type=Path, metavar='PNG', help='draw the map and its cost; .svg and .pdf too')
    add('--json', action='store_true', help='one object on standard output')
    add('--quiet', action='store_true', help='no progress, no summary')


def _add_convert(parser: argparse.ArgumentParser) -> None:
    _add_input(parser)
    parser.add_argument('output', type=Path, metavar='OUTPUT', help=_OUTPUT)


def _add_simulate(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('output', type=Path, metavar='OUTPUT',
        help=f'{_GRAPH_OUTPUT}; beside it OUTPUT.truth.txt and OUTPUT.false.txt')
    add('--poses', type=int, required=True, metavar='N')
    add('--edges', type=int, required=True, metavar='M', help='true ones, odometry included')
    add('--false-loops', type=int, default=0, metavar='K',
        help='on top of the edges (default: %(default)s)')
    _add_randomness(parser)


def _add_corrupt(parser: argparse.ArgumentParser) -> None:
    _add_input(parser)
    add = parser.add_argument
    add('output', type=Path, metavar='OUTPUT',
        help=f'{_GRAPH_OUTPUT}; beside it OUTPUT.false.txt, the vertex ids of the false loops')
    add('--false-loops', type=int, required=True, metavar='K', help='how many')
    _add_randomness(parser)


def _add_randomness(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--kind', choices=list(FALSE_LOOPS), default='random', help=_KIND)
    parser.add_argument('--seed', type=int, default=0, metavar='S',
                        help='another one, another draw (default: %(default)s)')


def _add_info(parser: argparse.ArgumentParser) -> None:
    _add_input(parser)


def _add_plot(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('input', type=Path, nargs='+', metavar='INPUT',
                        help=f'{_INPUT}; INPUT.truth.txt and INPUT.false.txt are drawn, if there')
    parser.add_argument('--output', type=Path, required=True, metavar='PNG',
                        help='.png, .svg or .pdf')
    _add_bag_options(parser)


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
