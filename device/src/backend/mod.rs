//! One folder per driver.

pub mod five_dof;
pub mod sim;
