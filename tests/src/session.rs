//! A session on one machine: a server and clients as child processes, with a bad network between them.
//!
//! The laboratory program plays all roles: `palpate-lab server ...` is the server, `palpate-lab client ...` a
//! client. One build serves for all.

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

/// Maximum time of a server until it listens.
const LISTEN_WITHIN: Duration = Duration::from_secs(60);

/// Maximum time of a participant from its start to its first view: the model download over a bad network.
const JOIN_WITHIN: Duration = Duration::from_secs(60);

/// Message of a client on standard error after it has joined.
const JOINED: &str = "joined as";

/// Words of a client on standard error before the address of its page.
const PAGE_AT: &str = "the page is at ";

/// Maximum time of a process from the request to its end: it writes its recording.
const END_WITHIN: Duration = Duration::from_secs(30);

/// Maximum size of a recording as JSON, bytes.
const RECORDING_BYTES_MAX: u64 = 1 << 30;

/// Loopback with any free port.
pub(crate) const HERE: SocketAddr = SocketAddr::new(std::net::IpAddr::V4(Ipv4Addr::LOCALHOST), 0);

/// Failure of a session.
#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    /// A process failed.
    #[error(transparent)]
    Program(#[from] ProgramError),
    /// The relay failed.
    #[error("the relay could not be started: {0}")]
    Relay(std::io::Error),
    /// The threads of connections within this process.
    #[error("the threads for connections of the laboratory could not be started: {0}")]
    Runtime(std::io::Error),
    /// Invalid join link of the server.
    #[error("the server printed an invalid join link: {0}")]
    Link(#[from] LinkError),
    /// No join link for a role.
    #[error("the server printed no join link for the role {0}")]
    NoLink(&'static str),
    /// Unreadable recording.
    #[error("the recording {} can not be read: {why}", path.display())]
    Recording {
        /// Path of the recording.
        path: PathBuf,
        /// Error.
        why: String,
    },
    /// Interrupted by the user.
    #[error("interrupted")]
    Interrupted,
}

/// Settings of the server and its network.
#[derive(Debug, Clone)]
pub struct Hosting<'a> {
    /// The laboratory program, which plays all roles.
    pub executable: &'a Path,
    /// The model file.
    pub model: &'a Path,
    /// The network between server and clients.
    pub profile: Profile,
    /// Seed of the packet fates.
    pub seed: u64,
    /// `adaptive`, `fixed:MS` or `none`.
    pub compensation: &'a str,
    /// Start the scripts once this many tools have joined.
    pub start_when: u16,
    /// Address of the page.
    pub view: Option<SocketAddr>,
    /// Number of seats, and of those among them that spectators may take; `None` for the defaults of the server.
    pub seats: Option<[u16; 2]>,
}

/// A running server behind a relay. Dropping it ends both.
pub struct Session {
    executable: PathBuf,
    /// The server process.
    pub server: Program,
    /// Its startup message.
    pub listening: Listening,
    relay: Relay,
}

/// A participant and its recording.
pub struct Participant {
    /// The process.
    pub program: Program,
    record: PathBuf,
}

/// Results of a participant.
#[derive(Debug, Clone)]
pub struct ParticipantResult {
    /// Its summary.
    pub summary: Summary,
    /// Its recording of forces and views.
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
        if let Some(view) = hosting.view {
            arguments.extend(["--view".into(), view.to_string().into()]);
        }
        if let Some([seats, spectators]) = hosting.seats {
            for (option, count) in [("--seats", seats), ("--spectators", spectators)] {
                arguments.extend([option.into(), count.to_string().into()]);
            }
        }
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

    /// Address of the instructor's page, if the session has one.
    pub fn page(&self) -> Option<&str> {
        self.listening.pages.get("instructor").map(String::as_str)
    }

    /// The join link for a role, straight to the server.
    pub fn direct_link(&self, role: &'static str) -> Result<JoinLink, SessionError> {
        let text = self.listening.links.get(role);
        Ok(text.ok_or(SessionError::NoLink(role))?.parse()?)
    }

    /// The join link for a role, through the relay.
    pub fn link(&self, role: &'static str) -> Result<JoinLink, SessionError> {
        let mut link = self.direct_link(role)?;
        let address = self.relay.local_addr();
        link.host = address.ip().to_string();
        link.port = address.port();
        Ok(link)
    }

    /// Starts a participant that records into `dir`.
    pub fn join(
        &self,
        name: &str,
        role: &'static str,
        script: Option<&Path>,
        dir: &Path,
    ) -> Result<Participant, SessionError> {
        self.start_client(name, role, script, None, dir)
    }

    /// The same, with a page of its own at any free port.
    pub fn join_with_view(
        &self,
        name: &str,
        role: &'static str,
        script: Option<&Path>,
        dir: &Path,
    ) -> Result<Participant, SessionError> {
        self.start_client(name, role, script, Some(HERE), dir)
    }

    fn start_client(
        &self,
        name: &str,
        role: &'static str,
        script: Option<&Path>,
        view: Option<SocketAddr>,
        dir: &Path,
    ) -> Result<Participant, SessionError> {
        let record = dir.join(format!("{name}.recording.json"));
        let link = self.link(role)?.to_string();
        let options = [
            "client",
            "join",
            &link,
            "--name",
            name,
            "--json",
            "--forget-seat",
            "--record",
        ];
        let mut arguments: Vec<OsString> = options.map(OsString::from).into();
        arguments.push(record.clone().into());
        if let Some(script) = script {
            arguments.push("--script".into());
            arguments.push(script.into());
            // Scripts of a session start at the same session time.
            arguments.extend(["--at", "session"].map(OsString::from));
        }
        if let Some(view) = view {
            arguments.extend(["--view".into(), view.to_string().into()]);
        }
        let program = Program::start(format!("client {name}"), &self.executable, arguments)?;
        Ok(Participant { program, record })
    }

    /// Statistics of the relay so far.
    pub fn network(&self) -> RelayStats {
        self.relay.stats()
    }

    /// Requests the server to end; returns its summary.
    pub fn end(mut self) -> Result<(HostSummary, RelayStats), SessionError> {
        self.server.ask_to_end();
        self.server.wait_for_success(END_WITHIN)?;
        let summary = self.server.last_json("the server's summary")?;
        Ok((summary, self.relay.stats()))
    }
}

impl Participant {
    /// Waits until the client reports that it has joined.
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

    /// Waits for the address of its page, which it prints after it has joined.
    pub fn page(&mut self) -> Result<String, SessionError> {
        let began = Instant::now();
        loop {
            if let Some(address) = self.program.said_after(PAGE_AT) {
                return Ok(address);
            }
            self.program.check_alive()?;
            if began.elapsed() > JOIN_WITHIN {
                return Err(self
                    .program
                    .late("print the address of its page", JOIN_WITHIN)
                    .into());
            }
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    /// Collects the results, after [`ask_to_end`](Program::ask_to_end) or after the process ended by itself.
    pub fn leave(mut self) -> Result<ParticipantResult, SessionError> {
        self.program.wait_for_success(END_WITHIN)?;
        Ok(ParticipantResult {
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
