"""softloop's command line, whose processes write down what Zenoh's access rules refuse (RUST_LOG of who starts it)."""

import sys

import zenoh

from softloop.deploy import children
from softloop.deploy.cli import main

if __name__ == "__main__":
    children.Children.__init__.__defaults__ = ((sys.executable, "-m", "tests.security.traced_cli"),)
    zenoh.init_log_from_env_or("error")
    main()
