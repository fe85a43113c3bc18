"""The process of the worker on Windows, as far as another system can tell: jobs, no console."""

import ctypes
import io
import subprocess

import pytest
from tests.addon.conftest import part


class Kernel:
    """Takes the calls that end a process tree on Windows, and keeps the flags of the job."""

    def __init__(self, refused=""):
        self.called, self.flags, self._refused = [], 0, refused

    def __getattr__(self, name):
        def call(*arguments):
            self.called.append((name, *arguments))
            if name == "SetInformationJobObject":
                self.flags = arguments[2]._obj.basic.flags
                assert arguments[3] == ctypes.sizeof(arguments[2]._obj)
            return 0 if name == self._refused else 77
        return call


@pytest.fixture()
def process(addon):
    return part("jobs.worker_process")


def test_the_job_object_ends_with_blender(process):
    """The structure is as long as Windows expects it; the worker is put in, and ends with it."""
    if ctypes.sizeof(ctypes.c_void_p) == 8:
        assert ctypes.sizeof(process._Limits) == 144
    kernel = Kernel()
    assert process._job_object(kernel, 5) == 77
    assert kernel.flags == 0x2000
    assert kernel.called[-1] == ("AssignProcessToJobObject", 77, 5)


@pytest.mark.parametrize("refused", ["CreateJobObjectW", "SetInformationJobObject",
                                     "AssignProcessToJobObject"])
def test_without_a_job_object_the_worker_itself_is_ended(process, refused):
    """Windows may refuse one inside another job: there is none then."""
    assert process._job_object(Kernel(refused), 5) is None


@pytest.mark.parametrize("job", [77, None])
def test_windows_gets_no_console_and_the_whole_tree_ends(process, monkeypatch, job):
    """No window of its own; asked to end, its input is closed; ended, all of it is."""
    started, killed, kernel = {}, [], Kernel()
    monkeypatch.setattr(process, "_POSIX", False)
    monkeypatch.setattr(process, "_kernel", lambda: kernel)
    monkeypatch.setattr(process, "_job_object", lambda _kernel, _handle: job)
    monkeypatch.setattr(subprocess.Popen, "__init__",
                        lambda self, command, **rest: (started.update(rest), vars(self).update(
                            stdout=io.StringIO(), stderr=io.StringIO())))
    monkeypatch.setattr(subprocess.Popen, "__del__", lambda self: None)
    monkeypatch.setattr(subprocess.Popen, "kill", lambda self: killed.append("worker"))
    monkeypatch.setattr(process.WorkerProcess, "_handle", 5, raising=False)
    worker = process.WorkerProcess(["limber"], LIMBER_PARENT_PIPE="stdin")
    assert started["creationflags"] == 0x08000000 and not started["start_new_session"]
    assert started["env"]["LIMBER_PARENT_PIPE"] == "stdin"
    worker.stdin = io.StringIO()
    worker.ask_to_end()
    assert worker.stdin.closed and not killed
    worker.end_now()
    assert (("TerminateJobObject", 77, 1) in kernel.called) == (job is not None)
    assert len(killed) == (job is None)
