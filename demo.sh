#!/bin/sh
# The demo, step by step, with the commands anybody would use. Usage: demo.sh FOLDER
set -eu
dir=$1
show() { echo; echo "\$ $*"; }
run() { show "$@"; "$@"; }

echo "A room is rendered, surveyed and flown through; trigpointd localizes the flight."
run trigpoint-db demo "$dir"

show trigpointd watch --listen tcp/127.0.0.1:17447 --poses "$dir/received.txt" \
  --exit-with-daemon "> $dir/watch.txt &"
trigpointd watch --listen tcp/127.0.0.1:17447 --poses "$dir/received.txt" \
  --exit-with-daemon > "$dir/watch.txt" &
watch=$!
trap 'kill "$watch" 2>/dev/null || true' EXIT
run trigpointd run --config "$dir/trigpointd.toml"
wait "$watch"
trap - EXIT

run head -n 3 "$dir/watch.txt"
run trigpoint-db evaluate --poses "$dir/received.txt" --truth "$dir/truth.txt" \
  --log "$dir/log.mcap" --picture "$dir/path.png"
