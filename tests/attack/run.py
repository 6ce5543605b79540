#!/usr/bin/env python3
"""Attacks the programs of target/release: python3 tests/attack/run.py [--long] [NAME...]

The short form takes less than 5 minutes. --long runs every generated case. A NAME selects tests that contain it,
for example `test_07`. The last line gives the number of cases per item.
"""
import argparse
import json
import os
import pathlib
import sys
import unittest


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--long", action="store_true", help="run every generated case")
    parser.add_argument("names", nargs="*", metavar="NAME", help="run only tests whose name contains NAME")
    arguments = parser.parse_args()
    if arguments.long:
        os.environ["DEMC_ATTACK"] = "long"
    folder = pathlib.Path(__file__).resolve().parent
    sys.path.insert(0, str(folder))
    import common
    loader = unittest.TestLoader()
    loader.testNamePatterns = [f"*{name}*" for name in arguments.names] or None
    outcome = unittest.TextTestRunner(verbosity=2).run(loader.discover(str(folder), top_level_dir=str(folder)))
    print(json.dumps({"cases": dict(sorted(common.COUNTS.items())), "failures": len(outcome.failures),
                      "errors": len(outcome.errors)}))
    return 0 if outcome.wasSuccessful() and outcome.testsRun else 1


if __name__ == "__main__":
    sys.exit(main())
