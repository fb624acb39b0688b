//! The tools of the participants: their poses at a time, their contact geometry and their strokes.

mod convert;
mod reach;
mod roster;
mod stroke;
mod tool_at;

pub use convert::tissue_stroke;
pub use reach::Reach;
pub use roster::Roster;
pub use stroke::StrokeCollector;
pub use tool_at::ToolAt;
pub(crate) use tool_at::gather;
