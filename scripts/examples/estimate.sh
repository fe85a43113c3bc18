#!/usr/bin/env bash
# Estimates Young's modulus of one branch from recordings, without a window:
#   estimate.sh NAME.branch RECORDING...
# In Blender instead: LIMBER="blender -b --command limber" estimate.sh ...
# A second run keeps results that are up to date. Options of the two stages: IMPORT="--unit mm",
# ESTIMATE="--fractions 0.3,0.7" (see --help).
set -euo pipefail
limber=${LIMBER:-limber}
branch=$1
shift
for recording in "$@"; do
  name=$(basename "${recording%.*}")
  # shellcheck disable=SC2086
  $limber import-pull "$branch" "$recording" --name "$name" ${IMPORT:-}
done
# The last line is one JSON object; the rest is for people.
# shellcheck disable=SC2086
$limber estimate "$branch" ${ESTIMATE:-} --json | tail -n 1 > "${branch%.branch}-estimate.json"
