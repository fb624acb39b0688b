//! The program: command line, one run from the join link to the summary, and its output.

pub mod cli;
mod command_line;
mod ending;
mod error;
mod join;
mod link_source;
mod options;
mod output;
mod status;
mod summary;
mod supervision;

pub(crate) use ending::Ending;
pub use error::ClientError;
pub use join::run;
pub use link_source::{LINK_VARIABLE, LinkSourceError};
pub use options::{JoinOptions, StartAt, StatusKind};
pub(crate) use output::{complain, print};
pub use summary::{EventCounts, SolveTimes, Summary};
