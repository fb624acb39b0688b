//! The tool of a script, in the protocol's terms.

use palpate_device::script::{Tool as ScriptTool, ToolKind as ScriptToolKind};
use palpate_protocol::tool::{ToolDescription, ToolKind};

/// The tool of a script, as a protocol description.
pub fn tool_description(tool: &ScriptTool) -> ToolDescription {
    ToolDescription {
        kind: match tool.kind {
            ScriptToolKind::Probe => ToolKind::Probe,
            ScriptToolKind::Blade => ToolKind::Scalpel,
            ScriptToolKind::Needle => ToolKind::Needle,
            ScriptToolKind::Plate => ToolKind::Plate,
            ScriptToolKind::Forceps => ToolKind::Grasper,
        },
        radius_m: tool.radius_m,
        length_m: tool.length_m,
        width_m: tool.width_m,
    }
}
