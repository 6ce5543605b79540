"""Runs `demc-infer denoise`. This file needs no Blender."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile

NAME = "demc-infer"


class Failure(Exception):
    """What went wrong, in one sentence for the user."""


class Job:
    """A running `demc-infer denoise`.

    `program` and `model` may be empty: then the program is searched on the PATH and uses the model `quality`. An empty
    `layer` is right for files with one view layer.
    """

    def __init__(self, program: str, source: str, target: str, model: str = "", layer: str = "") -> None:
        command = [executable(program), "denoise", "--overwrite", "-o", target]
        command += ["--model", model] if model else []
        command += ["--layer", layer] if layer else []
        # A file cannot fill up like a pipe that nobody reads.
        self.messages = tempfile.TemporaryFile()
        self.target = target
        options = {"creationflags": subprocess.CREATE_NO_WINDOW} if os.name == "nt" else {}
        try:
            self.process = subprocess.Popen(
                [*command, "--", source], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=self.messages, **options
            )
        except OSError as error:
            self.messages.close()
            raise Failure(f"{command[0]} cannot be started: {error.strerror}.") from error

    def running(self) -> bool:
        return self.process.poll() is None

    def stop(self) -> None:
        """Ends the program; an existing output stays as it was."""
        self.process.terminate()
        self.process.wait()
        self.messages.close()

    def finish(self) -> list[str]:
        """Waits for the end. Returns the program's warnings, or raises `Failure` with its error."""
        code = self.process.wait()
        self.messages.seek(0)
        lines = self.messages.read().decode(errors="replace").splitlines()
        self.messages.close()
        if code != 0:
            errors = [sentence(line) for line in lines if line.startswith("error: ")]
            raise Failure(errors[-1] if errors else f"{NAME} ended with code {code} and no message.")
        return [sentence(line) for line in lines if line.startswith("warning: ")]


def executable(program: str) -> str:
    """The full path of the program."""
    found = shutil.which(program or NAME)
    if found:
        return found
    if program:
        raise Failure(f"There is no program {program}: set the path of {NAME} in the panel.")
    raise Failure(f"{NAME} is not on the PATH: set its path in the panel.")


def sentence(line: str) -> str:
    """A message of the program without its first word."""
    text = line.partition(": ")[2].strip().rstrip(".")
    return f"{text[:1].upper()}{text[1:]}."
