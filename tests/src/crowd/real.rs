//! A crowd of a server's process: a QUIC connection for everybody, in real time.
//!
//! The members are tasks of this process. They share the machine with the server, so what matters is the
//! server's own time of the processor, and that the ticks of its summary hold although others wanted the
//! processors, too.

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
use crate::program::Program;
use crate::test_model::TestModel;

/// How long a server may take to read its model and listen, and to end.
const LISTEN_WITHIN: Duration = Duration::from_secs(60);
const END_WITHIN: Duration = Duration::from_secs(30);

/// How long somebody may take to come in.
const IN_WITHIN: Duration = Duration::from_secs(20);

/// Between two deliveries of samples to everybody, and the samples in one.
const EVERY: Duration = Duration::from_millis(4);
const SAMPLES: i64 = 4;

/// Before counting begins: clocks are locked and delays found.
const SETTLE: Duration = Duration::from_secs(1);

/// What is tried.
#[derive(Debug, Clone, Copy)]
pub struct Real<'a> {
    /// The tissue.
    pub model: &'a Arc<Model>,
    /// How many come.
    pub participants: usize,
    /// The seed of the motions.
    pub seed: u64,
    /// How long is counted, s.
    pub seconds: f64,
    /// Where the model's file may be kept.
    pub dir: &'a Path,
}

/// What came of it.
#[derive(Debug, Clone, Serialize)]
pub struct Row {
    /// How many came, and how many of them touch.
    pub participants: usize,
    /// How many of them touch.
    pub touching: usize,
    /// Time between two ticks, ms.
    pub period_ms: f64,
    /// Time that passed in a tick, ms.
    pub tick_ms: TickTimes,
    /// How long after its moment a tick began, ms.
    pub late_ms: TickTimes,
    /// Processors that the thread of the room and solver kept busy, and the other threads of the server.
    pub room_cores: f64,
    /// Processors that the other threads of the server kept busy.
    pub network_cores: f64,
    /// Processors that the members kept busy, which the server did not have.
    pub member_cores: f64,
    /// UDP payload of one member, with everything that QUIC adds, kbit/s.
    pub up_kbit_s: f64,
    /// The same, from the server.
    pub down_kbit_s: f64,
    /// Datagrams that the server had no room for, over the whole session.
    pub datagrams_skipped: u64,
    /// The largest that the server's process was, MB.
    pub memory_mb: Option<f64>,
    /// What one more was told who found all seats taken.
    pub one_more: String,
    /// Whether 99 of 100 ticks took less than the period.
    pub ok: bool,
}

impl Real<'_> {
    /// Runs it.
    pub fn run(&self) -> Result<Row, String> {
        let subject = TestModel::of(self.model.as_ref().clone(), self.dir);
        let file = subject.map_err(|e| e.to_string())?.file;
        let executable = std::env::current_exe()
            .map_err(|e| format!("this program does not know where it is: {e}"))?;
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
        let link = listening.links.get("trainee");
        let link: JoinLink = link
            .ok_or("the server printed no link for trainees")?
            .parse()
            .map_err(|e| format!("the server printed a link that can not be read: {e}"))?;
        let motions = motions(self.model, self.participants, self.seed)?;
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .map_err(|e| format!("no threads for the members: {e}"))?;
        let counted = runtime.block_on(self.live(&link, motions, server.id()))?;
        let memory_mb = peak_mb(server.id());
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
        link: &JoinLink,
        motions: Vec<Motion>,
        server: u32,
    ) -> Result<Counted, String> {
        let mut members = Vec::new();
        for (seat, motion) in motions.into_iter().enumerate() {
            members.push((come_in(link, seat).await?, motion));
        }
        let Err(one_more) = come_in(link, self.participants).await else {
            return Err("a server with all seats taken let one more in".to_owned());
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
                // What does not fit is dropped, as next to a real device.
                let _ = handle.commands.try_send(ClientCommand::Motion(samples));
                while let Ok(event) = handle.events.try_recv() {
                    if let ClientEvent::Closed(reason) = event {
                        return Err(format!("somebody was closed: {reason}"));
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

/// Bytes of UDP payload that members sent and received.
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
    let session = ClientSession::new(hello(seat, link.grant), monotonic_now());
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
        Err("the session ended without a word".to_owned())
    };
    match tokio::time::timeout(IN_WITHIN, welcomed).await {
        Ok(Ok(())) => Ok(handle),
        Ok(Err(sentence)) => Err(sentence),
        Err(_) => Err(format!("no answer within {} s", IN_WITHIN.as_secs())),
    }
}

/// Time of processors, s. Linux tells it per thread; elsewhere it is not known and zero.
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

/// Seconds of processor that every thread of a process has had: `/proc/PID/task/TID/schedstat` begins with
/// them in ns.
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

/// The largest that a process was, MB; Linux tells it.
fn peak_mb(process: u32) -> Option<f64> {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?;
    let kilobytes: f64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kilobytes / 1024.0)
}
