#!/usr/bin/env bash
# Makes a Blender scene and a picture of each branch, without a window:
#   render.sh NAME.branch...
# COLOR is young, strain, stress, strain_energy or det_f; WIDTH is in pixels; SIDES=48 also makes a
# turntable (.webp) with 48 views.
set -euo pipefail
limber=${LIMBER:-limber}
for branch in "$@"; do
  $limber scene "$branch" -o "${branch%.branch}.blend" --render "${branch%.branch}.png" \
    --color "${COLOR:-young}" --width "${WIDTH:-1120}" \
    ${SIDES:+--turntable "${branch%.branch}.webp" --sides "$SIDES"}
done
