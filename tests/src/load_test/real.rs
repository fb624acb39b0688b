//! Load test of a server process in real time, with one QUIC connection per participant.
//!
//! The participants are tasks of this process and share the machine with the server. The figures are
//! therefore the server's CPU time and its tick times under this competition.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use palpate_client::realtime::monotonic_now;
use palpate_protocol::session::{ClientEvent, ClientSession};
use palpate_protocol::{JoinLink, Span};
use palpate_server::host::{HostSummary, Listening, TickTimes};
use palpate_tissue::Model;
use palpate_transport::{ClientCommand, ClientHandle, connect, spawn_client};
use serde::Serialize;

use super::member::{Motion, hello};
use super::{motions, touching};
use crate::memory::Memory;
use crate::program::Program;
use crate::test_model::TestModel;

/// Time limits for the server's start, with reading of the model, and for its end.
const LISTEN_WITHIN: Duration = Duration::from_secs(60);
const END_WITHIN: Duration = Duration::from_secs(30);
const IN_WITHIN: Duration = Duration::from_secs(20);

/// Interval between two batches of samples, and samples per batch.
const EVERY: Duration = Duration::from_millis(4);
const SAMPLES: i64 = 4;

/// Time before the measurement: clocks lock and delays settle.
const SETTLE: Duration = Duration::from_secs(1);

#[derive(Debug, Clone, Copy)]
pub struct Real<'a> {
    pub model: &'a Arc<Model>,
    pub participants: usize,
    pub seed: u64,
    pub seconds: f64,
    /// Directory for the model's file.
    pub dir: &'a Path,
}

#[derive(Debug, Clone, Serialize)]
pub struct Row {
    pub participants: usize,
    pub touching: usize,
    pub period_ms: f64,
    pub tick_ms: TickTimes,
    pub late_ms: TickTimes,
    /// Cores that the server's room and solver thread kept busy.
    pub room_cores: f64,
    /// Cores that the server's other threads kept busy.
    pub network_cores: f64,
    /// Cores that the participants kept busy and the server could not use.
    pub member_cores: f64,
    /// Uplink UDP payload per participant with QUIC overhead, kbit/s.
    pub up_kbit_s: f64,
    pub down_kbit_s: f64,
    /// Datagrams the server skipped for lack of send capacity, over the whole session.
    pub datagrams_skipped: u64,
    pub memory_mb: Option<f64>,
    /// Error that a participant received when all seats were taken.
    pub one_more: String,
    /// Whether the 99th percentile of tick durations is below the period.
    pub ok: bool,
}

impl Real<'_> {
    pub fn run(&self) -> Result<Row, String> {
        let file = TestModel::of(self.model.as_ref().clone(), self.dir)?.file;
        let executable = std::env::current_exe()
            .map_err(|e| format!("cannot find this program's executable: {e}"))?;
        let seats = self.participants.to_string();
        let mut arguments: Vec<OsString> = vec!["server".into(), "host".into(), file.into()];
        let options = [
            "--json",
            "--identity",
            "new",
            "--listen",
            "127.0.0.1:0",
            "--seats",
            &seats,
        ];
        arguments.extend(options.map(OsString::from));
        let mut server =
            Program::start("server", &executable, arguments).map_err(|e| e.to_string())?;
        let listening: Listening = server
            .json("listen", LISTEN_WITHIN)
            .map_err(|e| e.to_string())?;
        let link = |role: &str| -> Result<JoinLink, String> {
            let link = listening.links.get(role);
            link.ok_or_else(|| format!("the server printed no {role} link"))?
                .parse()
                .map_err(|e| format!("the server printed an invalid {role} link: {e}"))
        };
        // One of more than two seats is for an instructor.
        let links = [link("instructor")?, link("trainee")?];
        let motions = motions(self.model, self.participants, self.seed)?;
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .map_err(|e| format!("cannot start the participants' runtime: {e}"))?;
        let counted = runtime.block_on(self.live(&links, motions, server.id()))?;
        let memory_mb = Memory::of(server.id()).map(|m| m.peak_mb);
        server.ask_to_end();
        server
            .wait_for_success(END_WITHIN)
            .map_err(|e| e.to_string())?;
        let summary: HostSummary = server
            .last_json("the server's summary")
            .map_err(|e| e.to_string())?;
        Ok(self.row(&counted, &summary, memory_mb))
    }

    async fn live(
        &self,
        links: &[JoinLink; 2],
        motions: Vec<Motion>,
        server: u32,
    ) -> Result<Counted, String> {
        let mut members = Vec::new();
        for (seat, motion) in motions.into_iter().enumerate() {
            let link = &links[usize::from(seat > 0)];
            members.push((come_in(link, seat).await?, motion));
        }
        let Err(one_more) = come_in(&links[1], self.participants).await else {
            return Err(
                "the server accepted a participant although all seats were taken".to_owned(),
            );
        };
        let began = Instant::now();
        let mut counting: Option<(Instant, Cpu, [u64; 2])> = None;
        let mut due = tokio::time::interval(EVERY);
        let start = monotonic_now();
        loop {
            due.tick().await;
            let now = monotonic_now();
            for (handle, motion) in &mut members {
                let sample = |k: i64| {
                    let time = now - Span::from_millis(SAMPLES - 1 - k);
                    motion.sample(time, (time - start).as_micros() as f64 * 1e-6)
                };
                let samples = (0..SAMPLES).map(sample).collect();
                // A full queue drops samples, as for a real device.
                let _ = handle.commands.try_send(ClientCommand::Motion(samples));
                while let Ok(event) = handle.events.try_recv() {
                    if let ClientEvent::Closed(reason) = event {
                        return Err(format!(
                            "the server closed a participant's session: {reason}"
                        ));
                    }
                }
            }
            match &counting {
                None if began.elapsed() >= SETTLE => {
                    counting = Some((Instant::now(), Cpu::now(server), bytes(&members)));
                }
                Some((from, cpu, before)) if from.elapsed().as_secs_f64() >= self.seconds => {
                    let after = bytes(&members);
                    return Ok(Counted {
                        seconds: from.elapsed().as_secs_f64(),
                        cpu: Cpu::now(server).since(cpu),
                        bytes: [after[0] - before[0], after[1] - before[1]],
                        one_more,
                    });
                }
                _ => {}
            }
        }
    }

    fn row(&self, counted: &Counted, summary: &HostSummary, memory_mb: Option<f64>) -> Row {
        let each = 8e-3 / counted.seconds / self.participants as f64;
        Row {
            participants: self.participants,
            touching: touching(self.participants),
            period_ms: summary.tick_period_ms,
            tick_ms: summary.tick_ms,
            late_ms: summary.late_ms,
            room_cores: counted.cpu.room / counted.seconds,
            network_cores: counted.cpu.other / counted.seconds,
            member_cores: counted.cpu.own / counted.seconds,
            up_kbit_s: counted.bytes[0] as f64 * each,
            down_kbit_s: counted.bytes[1] as f64 * each,
            datagrams_skipped: summary.datagrams_skipped,
            memory_mb,
            one_more: counted.one_more.clone(),
            ok: summary.tick_ms.p99 < summary.tick_period_ms,
        }
    }
}

struct Counted {
    seconds: f64,
    cpu: Cpu,
    bytes: [u64; 2],
    one_more: String,
}

/// Uplink and downlink UDP payload of all participants, bytes.
fn bytes(members: &[(ClientHandle, Motion)]) -> [u64; 2] {
    let mut sum = [0; 2];
    for (handle, _) in members {
        let path = handle.stats.borrow().path;
        sum[0] += path.sent_bytes;
        sum[1] += path.received_bytes;
    }
    sum
}

async fn come_in(link: &JoinLink, seat: usize) -> Result<ClientHandle, String> {
    let connection = connect(link).await.map_err(|e| e.to_string())?;
    let session = ClientSession::new(hello(seat, link.role, link.grant), monotonic_now());
    let session = session.map_err(|e| e.to_string())?;
    let mut handle = spawn_client(connection, session, monotonic_now);
    let welcomed = async {
        while let Some(event) = handle.events.recv().await {
            match event {
                ClientEvent::Welcomed(_) => return Ok(()),
                ClientEvent::Closed(reason) => return Err(reason.to_string()),
                _ => {}
            }
        }
        Err("the session ended without a reason".to_owned())
    };
    match tokio::time::timeout(IN_WITHIN, welcomed).await {
        Ok(Ok(())) => Ok(handle),
        Ok(Err(sentence)) => Err(sentence),
        Err(_) => Err(format!(
            "no reply to the join request within {} s",
            IN_WITHIN.as_secs()
        )),
    }
}

/// CPU time, s. Linux reports it per thread; on other systems it is zero.
#[derive(Debug, Clone, Copy, Default)]
struct Cpu {
    room: f64,
    other: f64,
    own: f64,
}

impl Cpu {
    fn now(server: u32) -> Self {
        let threads = threads_s(server);
        let room = threads.get(&server).copied().unwrap_or(0.0);
        Self {
            room,
            other: threads.values().sum::<f64>() - room,
            own: threads_s(std::process::id()).values().sum(),
        }
    }

    fn since(&self, before: &Self) -> Self {
        Self {
            room: self.room - before.room,
            other: self.other - before.other,
            own: self.own - before.own,
        }
    }
}

/// CPU time of each thread of a process, s. It is the first number of `/proc/PID/task/TID/schedstat`, in
/// ns.
fn threads_s(process: u32) -> BTreeMap<u32, f64> {
    let Ok(tasks) = std::fs::read_dir(format!("/proc/{process}/task")) else {
        return BTreeMap::new();
    };
    let of = |task: std::fs::DirEntry| -> Option<(u32, f64)> {
        let text = std::fs::read_to_string(task.path().join("schedstat")).ok()?;
        let ns: f64 = text.split_whitespace().next()?.parse().ok()?;
        Some((task.file_name().to_str()?.parse().ok()?, ns * 1e-9))
    };
    tasks.filter_map(Result::ok).filter_map(of).collect()
}
