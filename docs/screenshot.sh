#!/usr/bin/env bash
# Makes docs/view.png: the page of the reconstruction that experiments/tour.yaml makes, in headless Chromium.
# Usage: docs/screenshot.sh [RUN]; without a run, the latest of that experiment.
set -eu
cd "$(dirname "$0")/.."
run=${1:-$(ls -td runs/*-tour-*/ | head -n 1)}
page=$(cargo run --release --quiet -- view --print "$run")
browser=$(command -v chromium || command -v chromium-browser || command -v google-chrome)
"$browser" --headless --no-sandbox --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader \
    --window-size=1280,800 --virtual-time-budget=8000 --screenshot=docs/view.png "file://$(realpath "$page")#t=1.0"
