//! A session on this machine: a real server and real clients as processes of their own, and a bad
//! network between them.
//!
//! The laboratory's program plays all roles: started as `palpate-lab server ...` it is the server,
//! as `palpate-lab client ...` a client, so that one build serves for everything.

use std::ffi::OsString;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use palpate_client::{Recording, Summary};
use palpate_protocol::JoinLink;
use palpate_protocol::link::LinkError;
use palpate_server::host::{HostSummary, Listening};

use crate::program::{Program, ProgramError};
use crate::relay::{Profile, Relay, RelayStats};

/// How long a server may take to read its model and listen.
const LISTEN_WITHIN: Duration = Duration::from_secs(60);

/// How long a participant may take from its start to its first view: the model has to come through
/// a bad network.
const JOIN_WITHIN: Duration = Duration::from_secs(60);

/// What a client says on standard error when it is in.
const JOINED: &str = "joined as";

/// How long a process may take to end once it was asked to: it writes its recording.
const END_WITHIN: Duration = Duration::from_secs(30);

/// Longest recording that is read, bytes: what the bounds of a recording allow, as JSON.
const RECORDING_BYTES_MAX: u64 = 1 << 30;

/// Where everything listens.
const HERE: SocketAddr = SocketAddr::new(std::net::IpAddr::V4(Ipv4Addr::LOCALHOST), 0);

/// Why a session did not work.
#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    /// One of the processes.
    #[error(transparent)]
    Program(#[from] ProgramError),
    /// The relay.
    #[error("the relay could not be started: {0}")]
    Relay(std::io::Error),
    /// The server's link.
    #[error("the server printed a join link that can not be read: {0}")]
    Link(#[from] LinkError),
    /// The server gave no link for a role.
    #[error("the server printed no join link for the role {0}")]
    NoLink(&'static str),
    /// A recording.
    #[error("the recording {} can not be read: {why}", path.display())]
    Recording {
        /// Its file.
        path: PathBuf,
        /// What is wrong.
        why: String,
    },
    /// The user wants to end.
    #[error("interrupted")]
    Interrupted,
}

/// What to host, and behind what network.
#[derive(Debug, Clone)]
pub struct Hosting<'a> {
    /// The program to start in all roles: the laboratory itself.
    pub executable: &'a Path,
    /// The model file.
    pub model: &'a Path,
    /// The network between server and clients.
    pub profile: Profile,
    /// The seed of the packets' fates.
    pub seed: u64,
    /// `adaptive`, `fixed:MS` or `none`.
    pub compensation: &'a str,
    /// Scripts begin when so many tools are there.
    pub start_when: u16,
}

/// A running server behind a relay. Dropping it ends both.
pub struct Session {
    executable: PathBuf,
    /// The server's process.
    pub server: Program,
    /// What it said first.
    pub listening: Listening,
    relay: Relay,
}

/// A participant's process and where it records to.
pub struct Participant {
    /// The process.
    pub program: Program,
    record: PathBuf,
}

/// What a participant left behind.
#[derive(Debug, Clone)]
pub struct Left {
    /// Its figures.
    pub summary: Summary,
    /// What it felt and saw.
    pub recording: Recording,
}

impl Session {
    /// Starts a server and a relay in front of it.
    pub fn start(hosting: &Hosting<'_>) -> Result<Self, SessionError> {
        let mut arguments: Vec<OsString> = vec!["server".into(), "host".into()];
        arguments.push(hosting.model.into());
        let start_when = hosting.start_when.to_string();
        let listen = HERE.to_string();
        let options = [
            "--json",
            "--identity",
            "new",
            "--listen",
            &listen,
            "--start-when",
            &start_when,
            "--compensation",
            hosting.compensation,
        ];
        arguments.extend(options.map(OsString::from));
        let mut server = Program::start("server", hosting.executable, arguments)?;
        let listening: Listening = server.json("listen", LISTEN_WITHIN)?;
        let to = listening.listening;
        let relay = Relay::start(HERE, to, hosting.profile.clone(), hosting.seed)
            .map_err(SessionError::Relay)?;
        Ok(Self {
            executable: hosting.executable.to_owned(),
            server,
            listening,
            relay,
        })
    }

    /// The join link for a role, through the relay.
    pub fn link(&self, role: &'static str) -> Result<JoinLink, SessionError> {
        let text = self.listening.links.get(role);
        let mut link: JoinLink = text.ok_or(SessionError::NoLink(role))?.parse()?;
        let address = self.relay.local_addr();
        link.host = address.ip().to_string();
        link.port = address.port();
        Ok(link)
    }

    /// Lets somebody join, recording into `dir`.
    pub fn join(
        &self,
        name: &str,
        role: &'static str,
        script: Option<&Path>,
        dir: &Path,
    ) -> Result<Participant, SessionError> {
        let record = dir.join(format!("{name}.recording.json"));
        let link = self.link(role)?.to_string();
        let words = [
            "client",
            "join",
            &link,
            "--name",
            name,
            "--json",
            "--forget-seat",
            "--record",
        ];
        let mut arguments: Vec<OsString> = words.map(OsString::from).into();
        arguments.push(record.clone().into());
        if let Some(script) = script {
            arguments.push("--script".into());
            arguments.push(script.into());
            // The scripts of a session belong together.
            arguments.extend(["--at", "session"].map(OsString::from));
        }
        let program = Program::start(format!("client {name}"), &self.executable, arguments)?;
        Ok(Participant { program, record })
    }

    /// What the relay did so far.
    pub fn network(&self) -> RelayStats {
        self.relay.stats()
    }

    /// Asks the server to end, and takes its figures.
    pub fn end(mut self) -> Result<(HostSummary, RelayStats), SessionError> {
        self.server.ask_to_end();
        self.server.wait_for_success(END_WITHIN)?;
        let summary = self.server.last_json("the server's summary")?;
        Ok((summary, self.relay.stats()))
    }
}

impl Participant {
    /// Waits until it is in the session, which it says in a line of its own.
    pub fn wait_until_in(&mut self, interrupted: &dyn Fn() -> bool) -> Result<(), SessionError> {
        let began = Instant::now();
        while !self.program.has_said(JOINED) {
            self.program.check_alive()?;
            if interrupted() {
                return Err(SessionError::Interrupted);
            }
            if began.elapsed() > JOIN_WITHIN {
                return Err(self.program.late("join", JOIN_WITHIN).into());
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        Ok(())
    }

    /// Takes what it leaves behind, after [`ask_to_end`](Program::ask_to_end) or when it ended by
    /// itself.
    pub fn leave(mut self) -> Result<Left, SessionError> {
        self.program.wait_for_success(END_WITHIN)?;
        Ok(Left {
            summary: self.program.last_json("the client's summary")?,
            recording: read_recording(&self.record)?,
        })
    }
}

fn read_recording(path: &Path) -> Result<Recording, SessionError> {
    let bad = |why: String| SessionError::Recording {
        path: path.to_owned(),
        why,
    };
    let bytes = std::fs::metadata(path)
        .map_err(|e| bad(e.to_string()))?
        .len();
    if bytes > RECORDING_BYTES_MAX {
        return Err(bad(format!(
            "{bytes} bytes, more than {RECORDING_BYTES_MAX}"
        )));
    }
    let text = std::fs::read(path).map_err(|e| bad(e.to_string()))?;
    serde_json::from_slice(&text).map_err(|e| bad(e.to_string()))
}
