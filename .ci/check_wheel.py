"""Checks what a wheel holds: every tracked file of the packages, and nothing else."""

from __future__ import annotations

import subprocess
import sys
import zipfile

PACKAGES = ("emrld_jax", "envs_jax", "bridges")
ELSEWHERE = "bridges/ros2/"  # a package of its own, for a ROS workspace


def main() -> int:
    """Compares the wheel named by the argument with the repository; 1 if they differ."""
    held = {n for n in zipfile.ZipFile(sys.argv[1]).namelist() if ".dist-info/" not in n}
    listed = subprocess.run(
        ["git", "ls-files", *PACKAGES, f":!{ELSEWHERE}"], check=True, capture_output=True, text=True
    ).stdout.split()
    for words, names in (("lacks", set(listed) - held), ("should not hold", held - set(listed))):
        if names:
            print(f"the wheel {words}: {', '.join(sorted(names))}", file=sys.stderr)
    print(f"wheel: {len(held)} files")
    return int(held != set(listed))


if __name__ == "__main__":
    sys.exit(main())
