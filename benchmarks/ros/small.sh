#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# The whole of it on a small computer: one core, and 1 GB by control groups of version 1 (as root).
#
#   bash benchmarks/ros/small.sh DATASETS
#
# City live at 40 keyframes a second, the Intel log with scans at 40 a second, and the demo, see
# small.py and scans.py. It ends with 1 where a node or the demo was killed or failed.
set -euo pipefail
data=$(realpath "$1")
cd "$(dirname "$0")/../.."
python=${PYTHON:-python}
memory=/sys/fs/cgroup/memory/small
cpu=/sys/fs/cgroup/cpu/small
code=0

small() {  # the title of a run, and its command, which gets the groups behind it or as {}
    echo "== $1"
    shift
    mkdir "$memory" "$cpu"  # anew each time: they remember the most memory
    echo 1G > "$memory/memory.limit_in_bytes"
    echo 200000 > "$cpu/cpu.shares"
    "${@/\{\}/$memory:$cpu}" || code=1
    sleep 1
    rmdir "$memory" "$cpu"
}

trap 'rmdir "$memory" "$cpu" 2> /dev/null || true' EXIT
small 'City, 10,000 keyframes live' "$python" benchmarks/ros/small.py "$data/city10000.g2o" {}
small 'Intel, with scans' "$python" benchmarks/ros/scans.py \
    "$data/lidar/intel.clf.bz2" "$data/lidar/intel.truth.csv" 40 {}
small 'the demo' "$python" benchmarks/ros/small.py within {} \
    "$python" -m l1slam_ros.ros.executables
exit "$code"
