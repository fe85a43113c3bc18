"""The base of all panels in the sidebar."""


class SidebarPanel:
    """Mix-in: a panel of the tab "Limber" in the 3D view."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Limber"
