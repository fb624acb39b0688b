//! The cuts of a session in a file, with which a restarted host continues.
//!
//! ```text
//! header     "palpcuts", protocol version u16, hash of the model u64
//! records    kind u8, length u32, payload, XXH3 of these three u64; all numbers little endian
//!   1        a snapshot
//!   2        a change of the topology: an operation of the log
//! ```
//!
//! A thread of its own writes each change and forces it to the disk, several together if they arrive meanwhile: a cut is
//! in the file some milliseconds after it is in the log. Each snapshot of the log replaces the file. A record that a
//! crash has left unfinished is dropped.

use std::fs::{File, OpenOptions, TryLockError};
use std::io::{ErrorKind, Write as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;
use std::time::Duration;

use palpate_protocol::codec::{PREFIX_BYTES, decode_body, encode_frame};
use palpate_protocol::handshake::PROTOCOL_VERSION;
use palpate_protocol::operation::{CutStroke, Operation};
use palpate_protocol::request::ServerMessage;
use palpate_protocol::{ParticipantId, TopologyHash};
use palpate_room::TopologyState;
use palpate_site::repeat_change;
use palpate_tissue::file::Staged;
use palpate_tissue::snapshot::{model_hash, restore, snapshot};
use palpate_tissue::{CutHistory, Model, Tissue, Topology};
use palpate_transport::threads::{self, ThreadClass};
use xxhash_rust::xxh3::xxh3_64;

use crate::ServerError;

const MAGIC: [u8; 8] = *b"palpcuts";
const HEADER_BYTES: usize = 18;
const SNAPSHOT: u8 = 1;
const CHANGE: u8 = 2;

/// Time between two attempts to write after an error.
const RETRY: Duration = Duration::from_secs(1);

/// Tissue that an earlier session has left.
pub(super) struct Continued {
    pub(super) tissue: Tissue,
    pub(super) state: TopologyState,
    /// Restores this state.
    pub(super) snapshot: Vec<u8>,
    /// The latest participant whose strokes it has.
    pub(super) newest: ParticipantId,
    /// Numbers of the strokes in effect, then of those taken back.
    pub(super) strokes: [Vec<u64>; 2],
}

/// The file of a running session.
pub(super) struct SessionFile {
    entries: Sender<Entry>,
    writer: JoinHandle<bool>,
}

enum Entry {
    Change(Arc<Operation>),
    Snapshot(u32, Vec<u8>),
}

impl SessionFile {
    /// Opens or creates the file of a session with this model. Returns the tissue that it holds, if that has ever been cut.
    pub(super) fn open(
        path: &Path,
        model: &Arc<Model>,
    ) -> Result<(Self, Option<Continued>), ServerError> {
        if std::fs::metadata(path).is_ok_and(|at| !at.is_file()) {
            return Err(ServerError::Option(format!(
                "{} is no regular file, which a session file has to be",
                path.display()
            )));
        }
        let (old, bytes) = match File::open(path) {
            Ok(file) => {
                lock(&file, path)?;
                let bytes = std::fs::read(path).map_err(|e| failed("read", path, e))?;
                (Some(file), bytes)
            }
            Err(e) if e.kind() == ErrorKind::NotFound => (None, Vec::new()),
            Err(e) => return Err(failed("read", path, e)),
        };
        let model_hash = model_hash(model);
        let mut writer = Writer {
            path: path.to_owned(),
            file: None,
            header: header(model_hash),
            snapshot: None,
            changes: Vec::new(),
        };
        let mut continued = None;
        if !bytes.is_empty() {
            let contents = Contents::read(&bytes, model_hash)
                .map_err(|why| ServerError::Option(format!("{} {why}", path.display())))?;
            if contents.damaged > 0 {
                let kept = keep_damaged(path, &bytes)?;
                tracing::warn!(
                    "the last {} bytes of {} are unfinished and were left out; {} has the whole file",
                    contents.damaged,
                    path.display(),
                    kept.display()
                );
            }
            continued = contents.restored(model).map_err(|why| {
                ServerError::Option(format!(
                    "{} can not be continued: {why}; give another file to begin with uncut tissue",
                    path.display()
                ))
            })?;
        }
        if let Some(from) = &continued {
            writer.snapshot = Some(record(SNAPSHOT, &from.snapshot));
        }
        writer.replace().map_err(|e| failed("write", path, e))?;
        drop(old);
        let (entries, waiting) = channel();
        let writer = threads::spawn(ThreadClass::Background, "session file", move || {
            writer.run(&waiting)
        })
        .map_err(|e| failed("write", path, e))?;
        Ok((Self { entries, writer }, continued))
    }

    /// Writes the changes of the topology among new operations of the log.
    pub(super) fn note(&self, new: &[Arc<Operation>]) {
        for operation in new.iter().filter(|o| o.kind.changes_topology()) {
            let _ = self.entries.send(Entry::Change(Arc::clone(operation)));
        }
    }

    /// Replaces the file by a snapshot and the changes after it.
    pub(super) fn cover(&self, version: u32, bytes: &[u8]) {
        let _ = self.entries.send(Entry::Snapshot(version, bytes.to_vec()));
    }

    /// Ends the thread. Returns whether the file has everything.
    pub(super) fn finish(self) -> bool {
        drop(self.entries);
        self.writer.join().unwrap_or(false)
    }
}

/// Prevents that two hosts write to one file.
fn lock(file: &File, path: &Path) -> Result<(), ServerError> {
    match file.try_lock() {
        Ok(()) => Ok(()),
        Err(TryLockError::WouldBlock) => Err(ServerError::Option(format!(
            "{} is in use by another host; end that one, or give another file",
            path.display()
        ))),
        Err(TryLockError::Error(e)) => Err(failed("lock", path, e)),
    }
}

fn failed(what: &str, path: &Path, source: std::io::Error) -> ServerError {
    ServerError::Io {
        doing: format!("cannot {what} the session file {}", path.display()),
        source,
    }
}

/// Copies a file with damage beside it, so that nothing of it is lost. Earlier copies stay.
fn keep_damaged(path: &Path, bytes: &[u8]) -> Result<PathBuf, ServerError> {
    let mut kept = PathBuf::new();
    for number in 1.. {
        let mut name = path.as_os_str().to_owned();
        name.push(format!(".damaged-{number}"));
        kept = PathBuf::from(name);
        if !kept.exists() {
            break;
        }
    }
    palpate_tissue::file::write_file(&kept, bytes)?;
    Ok(kept)
}

fn header(model_hash: u64) -> [u8; HEADER_BYTES] {
    let mut header = [0; HEADER_BYTES];
    header[..8].copy_from_slice(&MAGIC);
    header[8..10].copy_from_slice(&PROTOCOL_VERSION.to_le_bytes());
    header[10..].copy_from_slice(&model_hash.to_le_bytes());
    header
}

fn record(kind: u8, payload: &[u8]) -> Vec<u8> {
    let mut out = vec![kind];
    out.extend((payload.len() as u32).to_le_bytes());
    out.extend(payload);
    out.extend(xxh3_64(&out).to_le_bytes());
    out
}

/// A file that was read.
struct Contents {
    snapshot: Option<Vec<u8>>,
    changes: Vec<Operation>,
    /// Bytes after the last whole record.
    damaged: usize,
}

impl Contents {
    /// The error completes a sentence that begins with the path.
    fn read(bytes: &[u8], model: u64) -> Result<Self, String> {
        let own = header(model);
        let Some((found, mut rest)) = bytes.split_at_checked(HEADER_BYTES) else {
            return Err("is no session file".to_owned());
        };
        if found[..8] != MAGIC {
            return Err("is no session file".to_owned());
        }
        if found[8..10] != own[8..10] {
            let version = u16::from_le_bytes([found[8], found[9]]);
            return Err(format!(
                "was written by a program with protocol version {version}, and this one has {PROTOCOL_VERSION}; host \
                 it with that program"
            ));
        }
        if found != own {
            return Err(
                "belongs to another model; host the model that it was made with, or give another file"
                    .to_owned(),
            );
        }
        let (mut snapshot, mut changes) = (None, Vec::new());
        while let Some((kind, payload, after)) = next_record(rest) {
            match kind {
                SNAPSHOT => {
                    snapshot = Some(payload.to_vec());
                    changes.clear();
                }
                _ => match decode_body::<ServerMessage>(payload) {
                    Ok(ServerMessage::Operation(operation)) => changes.push(operation),
                    _ => break,
                },
            }
            rest = after;
        }
        if is_damaged(rest) {
            return Err(format!(
                "is damaged at byte {}; give another file to begin with uncut tissue, or cut a copy of it there to continue \
                 with what is before",
                bytes.len() - rest.len()
            ));
        }
        Ok(Self {
            snapshot,
            changes,
            damaged: rest.len(),
        })
    }

    /// Repeats the cuts; `None` without any.
    fn restored(self, model: &Arc<Model>) -> Result<Option<Continued>, String> {
        let uncut = Arc::new(Topology::new(Arc::clone(model)));
        let (mut topology, mut history) = match &self.snapshot {
            Some(bytes) => restore(&uncut, bytes).map_err(|e| e.to_string())?,
            None => (Arc::clone(&uncut), CutHistory::new(uncut)),
        };
        for operation in &self.changes {
            repeat_change(&mut topology, &mut history, operation).map_err(|e| e.to_string())?;
        }
        if topology.version() == 0 {
            return Ok(None);
        }
        let state = (topology.version(), TopologyHash(topology.hash().0));
        let numbers = history.stroke_numbers();
        let authors = numbers.iter().flatten().map(|n| CutStroke::author_of(*n));
        Ok(Some(Continued {
            state,
            snapshot: snapshot(&topology, &history),
            newest: authors.max().unwrap_or(ParticipantId(0)),
            strokes: numbers,
            tissue: Tissue::with_history(topology, history),
        }))
    }
}

/// The kind and the payload of the first record, and the bytes after it; `None` if it is not whole.
fn next_record(bytes: &[u8]) -> Option<(u8, &[u8], &[u8])> {
    let length = u32::from_le_bytes(bytes.get(1..5)?.try_into().ok()?) as usize;
    let (own, after) = bytes.split_at_checked(5 + length)?;
    let (sum, after) = after.split_at_checked(8)?;
    let is_whole = xxh3_64(own).to_le_bytes() == sum && [SNAPSHOT, CHANGE].contains(&own[0]);
    is_whole.then_some((own[0], &own[5..], after))
}

/// Whether the bytes after the last whole record are no unfinished write. That appends a change, and ends before it is
/// complete, or has zeros after a power failure.
fn is_damaged(rest: &[u8]) -> bool {
    let length = rest.get(1..5).and_then(|l| l.try_into().ok());
    let length = length.map(|l| 5 + u32::from_le_bytes(l) as usize + 8);
    let is_complete = length.is_some_and(|length| rest.len() >= length);
    rest.first() == Some(&SNAPSHOT) || (is_complete && rest.iter().any(|b| *b != 0))
}

/// Writes the file. Its whole content is also in memory, so that it can be written again after an error.
struct Writer {
    path: PathBuf,
    /// Open at its end; `None` after an error.
    file: Option<File>,
    header: [u8; HEADER_BYTES],
    /// The record of the newest snapshot.
    snapshot: Option<Vec<u8>>,
    /// Topology versions after the changes since then, and their records.
    changes: Vec<(u32, Vec<u8>)>,
}

impl Writer {
    /// Writes until the queue closes. Returns whether the file has everything.
    fn run(mut self, waiting: &Receiver<Entry>) -> bool {
        loop {
            let first = if self.file.is_some() {
                waiting.recv().map_err(|_| RecvTimeoutError::Disconnected)
            } else {
                waiting.recv_timeout(RETRY)
            };
            if matches!(first, Err(RecvTimeoutError::Disconnected)) {
                break;
            }
            let written = self.changes.len();
            let mut is_covered = false;
            for entry in first.into_iter().chain(waiting.try_iter()) {
                is_covered |= self.take(entry);
            }
            let was_kept = self.file.is_some();
            let result = match &mut self.file {
                Some(file) if !is_covered => append(file, &self.changes[written..]),
                _ => self.replace(),
            };
            let place = self.path.display();
            match result {
                Ok(()) if was_kept => {}
                Ok(()) => tracing::info!("the cuts are in {place} again"),
                Err(error) => {
                    self.file = None;
                    if was_kept {
                        tracing::error!(
                            "the cuts can not be kept in {place} and are only in memory: {error}"
                        );
                    }
                }
            }
        }
        self.file.is_some() || self.replace().is_ok()
    }

    /// Returns whether the file has to be replaced.
    fn take(&mut self, entry: Entry) -> bool {
        match entry {
            Entry::Change(operation) => {
                let version = operation.topology_version_after;
                let message = ServerMessage::Operation((*operation).clone());
                match encode_frame(&message) {
                    Ok(frame) => {
                        let change = record(CHANGE, &frame[PREFIX_BYTES..]);
                        self.changes.push((version, change));
                    }
                    // Participants receive operations in such frames, too.
                    Err(error) => tracing::error!("a cut can not be kept: {error}"),
                }
                false
            }
            Entry::Snapshot(version, bytes) => {
                self.snapshot = Some(record(SNAPSHOT, &bytes));
                self.changes.retain(|(after, _)| *after > version);
                true
            }
        }
    }

    /// Replaces the file by one with everything. A crash leaves the old or the new one.
    fn replace(&mut self) -> std::io::Result<()> {
        self.file = None;
        let staged = Staged::write(&self.path, |out| {
            out.write_all(&self.header)?;
            let changes = self.changes.iter().map(|(_, record)| record);
            let mut records = self.snapshot.iter().chain(changes);
            records.try_for_each(|record| out.write_all(record))
        });
        let put = staged.and_then(Staged::put_in_place);
        put.map_err(|e| std::io::Error::other(e.to_string()))?;
        let file = OpenOptions::new().append(true).open(&self.path)?;
        // Only a host that began at this moment could have it.
        let _ = file.try_lock();
        self.file = Some(file);
        Ok(())
    }
}

fn append(file: &mut File, changes: &[(u32, Vec<u8>)]) -> std::io::Result<()> {
    let bytes: Vec<u8> = changes
        .iter()
        .flat_map(|(_, record)| record)
        .copied()
        .collect();
    file.write_all(&bytes)?;
    file.sync_data()
}

#[cfg(test)]
mod tests;
