//! One folder per driver.

pub mod five_dof;
pub mod replay;
pub mod sim;
