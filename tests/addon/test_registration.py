"""The add-on comes and goes without a trace."""

import importlib

import pytest


def _ours(bpy):
    return {name for name in dir(bpy.types) if name.startswith("LIMBER_")} | (
        {"Scene.limber"} if hasattr(bpy.types.Scene, "limber") else set()) | (
        {"bpy.ops.limber"} if "reconstruct" in dir(bpy.ops.limber) else set())


def test_registers_twice(bpy, addon):
    """Register, unregister, and again: every class is there, then none."""
    for _ in range(2):
        addon.register()
        there = _ours(bpy)
        assert {"LIMBER_PT_scan", "LIMBER_PT_report", "LIMBER_PT_result", "LIMBER_FH_cloud",
                "LIMBER_PT_play", "LIMBER_OT_plan", "LIMBER_OT_import_cloud",
                "LIMBER_OT_reconstruct",
                "LIMBER_OT_open_result", "LIMBER_OT_play", "LIMBER_OT_cancel_job",
                "LIMBER_OT_check_worker", "Scene.limber", "bpy.ops.limber"} <= there
        addon.unregister()
        assert not _ours(bpy)


def test_failed_registration_leaves_nothing(bpy, addon, monkeypatch):
    """If one module cannot register, those before it are taken back and the error is seen."""
    panel = importlib.import_module("limber_addon.plan.play_panel")

    def refuse():
        raise RuntimeError("no")

    monkeypatch.setattr(panel, "register", refuse)
    with pytest.raises(RuntimeError, match="no"):
        addon.register()
    assert not _ours(bpy)


@pytest.mark.slow
def test_command_entry(registered, capfd):
    """`blender --command limber ARGUMENTS` is `limber ARGUMENTS`: output and exit code."""
    command = importlib.import_module("limber_addon.command")
    assert command.run_command(["--version"]) == 0
    assert "limber" in capfd.readouterr().out
    assert command.run_command(["scene", "nowhere.branch", "-o", "x.blend"]) == 2
    assert "There is no folder" in capfd.readouterr().err


def test_command_entry_without_worker(registered, capfd, monkeypatch):
    """Without a worker the command says what to do and ends with the code for failed work."""
    command = importlib.import_module("limber_addon.command")
    monkeypatch.setenv("LIMBER_PYTHON", "/nowhere/python")
    assert command.run_command(["doctor"]) == 3
    message = capfd.readouterr().err
    assert "/nowhere/python" in message
    assert "preferences" in message
