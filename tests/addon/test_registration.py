"""The add-on comes and goes without a trace."""


import pytest
from tests.addon.conftest import part


def _ours(bpy):
    return {name for name in dir(bpy.types) if name.startswith("LIMBER_")} | (
        {"Scene.limber"} if hasattr(bpy.types.Scene, "limber") else set()) | (
        {"bpy.ops.limber"} if "reconstruct" in dir(bpy.ops.limber) else set())


def test_registers_twice(bpy, addon):
    """Register, unregister, and again: every class is there, then none."""
    for _ in range(2):
        addon.register()
        assert {"LIMBER_PT_scan", "LIMBER_PT_report", "LIMBER_PT_play", "LIMBER_FH_cloud",
                "LIMBER_OT_plan", "LIMBER_OT_open_result", "Scene.limber",
                "bpy.ops.limber"} <= _ours(bpy)
        addon.unregister()
        assert not _ours(bpy)


def test_failed_registration_leaves_nothing(bpy, addon, monkeypatch):
    """If one module cannot register, those before it are taken back and the error is seen."""
    last = part("command")

    def refuse():
        raise RuntimeError("no")

    monkeypatch.setattr(last, "register", refuse)
    with pytest.raises(RuntimeError, match="no"):
        addon.register()
    assert not _ours(bpy)


@pytest.mark.slow
def test_command_entry(registered, capfd):
    """`blender --command limber ARGUMENTS` is `limber ARGUMENTS`: output and exit code."""
    command = part("command")
    assert command.run_command(["--version"]) == 0
    assert "limber" in capfd.readouterr().out
    assert command.run_command(["scene", "nowhere.branch", "-o", "x.blend"]) == 2
    assert "There is no folder" in capfd.readouterr().err


def test_command_entry_without_worker(registered, capfd, monkeypatch):
    """Without a worker the command says what to do and ends with the code for failed work."""
    command = part("command")
    monkeypatch.setenv("LIMBER_PYTHON", "/nowhere/python")
    assert command.run_command(["doctor"]) == 3
    message = capfd.readouterr().err
    assert "/nowhere/python" in message
    assert "preferences" in message
