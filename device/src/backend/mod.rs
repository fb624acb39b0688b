//! One folder per driver; `steered` is what those share that steer a tool.

pub mod five_dof;
pub mod gamepad;
pub mod pointer;
pub mod replay;
pub mod sim;
pub mod spacemouse;
pub mod steered;
