#!/usr/bin/env bash
# Takes the README's picture of the window: a real window on a virtual screen, its own screenshot key.
# usage: assets/window.sh PROGDF DEMO_FOLDER OUT.png
set -euo pipefail
progdf=$(realpath "$1") demo=$(realpath "$2") out=$(realpath -m "$3")
export DISPLAY=:97
folder=$(mktemp -d)
Xvfb "$DISPLAY" -screen 0 1280x800x24 -noreset >/dev/null 2>&1 &
screen=$!
trap 'kill "$screen"; rm -rf "$folder"' EXIT
sleep 1
cd "$folder"
"$progdf" view "$demo/scene.ply" "$demo"/*/scarf.gdf "$demo"/*/gold.gdf "$demo"/*/frost.gdf "$demo"/*/panda.gdf \
  --set scarf=0.9 --set gold=0.7 --background '#82a3c2' &
window=$!
xdotool search --sync --onlyvisible --name scene.ply >/dev/null
sleep 20 # the first picture on a machine compiles the rasterizer
xdotool key shift+g # without the ground grid
sleep 1
xdotool key shift+F2
sleep 3
xdotool key ctrl+q
wait "$window"
mv "$(ls -t "$demo"/scene_*.png | head -1)" "$out" # pictures are saved beside the scene
