#!/bin/sh
# The report in a real browser, Debian's chromium, which is installed if it is missing.
# Usage: tests/experiments/reports/report/report_in_browser.sh [RESULT]   (RESULT: a result folder to open as well)
set -eu
cd "$(dirname "$0")/../../../.."
if [ -z "${CHROMIUM:-}" ] && ! command -v chromium >/dev/null; then
    if [ "$(id -u)" != 0 ]; then
        echo "browser-test: chromium is missing; install it, or run this as root" >&2
        exit 2
    fi
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends chromium
fi
CHROMIUM="${CHROMIUM:-$(command -v chromium)}"
export CHROMIUM
if [ $# -gt 0 ]; then
    RESULT="$1"
    export RESULT
fi
exec "${PYTHON:-.venv/bin/python}" -m pytest tests/experiments/reports/report/report_in_browser.py -s
