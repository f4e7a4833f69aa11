"""Whether this machine can make networks: nothing and exit code 0, or one line and exit code 3."""

import sys

from tests.net.lab import missing


def main() -> int:
    lacks = missing()
    if lacks:
        print(f"test-net: {lacks}", file=sys.stderr)
    return 3 if lacks else 0


if __name__ == "__main__":
    sys.exit(main())
