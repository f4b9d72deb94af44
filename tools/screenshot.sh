#!/bin/sh
# Draw a recording as rerun shows it, without a screen: tools/screenshot.sh RUN.mcap [OUT.png]
# Needs, beside the package with its view extra (in $VENV, default .venv), the Debian packages
# xvfb mesa-vulkan-drivers libxkbcommon-x11-0 libxcursor1 libxi6 libxrandr2
set -eu
run=${1:?usage: tools/screenshot.sh RUN.mcap [OUT.png]}
out=${2:-docs/images/view.png}
bin=${VENV:-.venv}/bin
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

"$bin/rerun" analytics disable >/dev/null
"$bin/python" -m plow_twin view "$run" --out "$work/run.rrd" --quiet
XDG_RUNTIME_DIR="$work" RUST_LOG=error timeout 120 xvfb-run -a -s "-screen 0 1600x1000x24" \
    "$bin/rerun" --window-size 1400x900 --screenshot-to "$work/shot.png" "$work/run.rrd"
# 256 colours at the size of the window: a tenth of the bytes
"$bin/python" - "$work/shot.png" "$out" <<'PYTHON'
import sys
from PIL import Image

picture = Image.open(sys.argv[1]).convert("RGB")
height = round(1400 * picture.height / picture.width)
picture.resize((1400, height), Image.Resampling.LANCZOS).quantize(256).save(sys.argv[2], optimize=True)
PYTHON
echo "$out"
