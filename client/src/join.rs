//! A run from the join link to the summary.

use std::sync::Arc;

use palpate_device::Script;
use palpate_protocol::handshake::Hello;
use palpate_protocol::{JoinLink, Role};

use crate::convert::tool_description;
use crate::network::Network;
use crate::{ClientError, JoinOptions, Summary};

/// Joins a session and stays until it ends, the duration is over or `stop` is set.
pub fn run(options: &JoinOptions) -> Result<Summary, ClientError> {
    let link: JoinLink = options.link.parse()?;
    let script = load_script(options, link.role)?;
    let hello = Hello {
        name: options.name.clone(),
        role: link.role,
        grant: link.grant,
        tool: script.as_ref().map(|s| tool_description(&s.tool())),
        resume: None,
    };
    let stop = Arc::clone(&options.stop);
    let network = Network::open(link, hello, Box::new(|_, _| {}), stop, options.catch_signals)?;
    let _ = palpate_tissue::decode_model(&network.model)?;
    network.leave();
    Ok(Summary::default())
}

/// The script of who holds a tool; `None` for who only looks.
fn load_script(options: &JoinOptions, role: Role) -> Result<Option<Script>, ClientError> {
    if !role.has_tool() {
        return Ok(None);
    }
    let path = options
        .script
        .clone()
        .ok_or(ClientError::NoScript(role))?;
    match Script::load(&path) {
        Ok(script) => Ok(Some(script)),
        Err(source) => Err(ClientError::Script { path, source }),
    }
}
