//! `bench late-join`: time of a join to a session with many cuts, from the snapshot and from the whole log.
//!
//! Blades cut rows of strokes in parts of 2 mm across the surface, in several directions, until the log has the wanted
//! number of parts. The server takes a snapshot after every 64 of them. The server then takes back every stroke, and a
//! trainee joins with the log from before. All times are elapsed times without the network and without the model, on all processors.

use std::fmt;
use std::sync::Arc;
use std::time::Instant;

use clap::Args;
use palpate_protocol::handshake::{ModelInfo, RosterEntry, SnapshotInfo, Welcome};
use palpate_protocol::operation::{
    BladePoint, CompensationMode, CompensationSettings, CutStroke, Operation, OperationKind,
};
use palpate_protocol::session::ClientEvent;
use palpate_protocol::tool::ToolDescription;
use palpate_protocol::{
    ClientTime, Epoch, ModelHash, OperationId, ParticipantId, ResumeToken, Role, ServerTime,
    TopologyHash,
};
use palpate_site::{CutOrder, Site, tissue_stroke};
use palpate_tissue::snapshot::snapshot;
use palpate_tissue::{CutPreparer, Model, Tissue, Topology};
use serde::Serialize;

use super::{Benchmark, OnStage, quantile};
use crate::memory::Memory;
use crate::test_model::TestModel;
use crate::tool_location::ToolLocation;

/// Changes of the topology between two snapshots, as in the room.
const SNAPSHOT_EVERY: usize = 64;
/// Steps of the blade and of a part, m.
const STEP_M: f64 = 0.75e-3;
const PART_STEPS: usize = 3;
/// Points that part nothing, after which a stroke ends.
const POINTS_MAX: usize = 256;
/// Half the length of a stroke, and depth of the first direction, m.
const REACH_M: f64 = 0.045;
const DEPTH_M: f64 = 0.010;
/// Directions of strokes, each deeper than the one before by this, m.
const DIRECTIONS: usize = 6;
const DEEPER_M: f64 = 2e-3;
/// Distance of rows, in spacings.
const ROWS: f64 = 1.5;
/// Blade length outside the tissue, m.
const OUTSIDE_M: f64 = 0.006;

const ME: ParticipantId = ParticipantId(1);
const SURGEON: ParticipantId = ParticipantId(2);

#[derive(Debug, Clone, Args)]
pub struct LateJoin {
    /// A model file (.palp), a scene (.toml), or a sample: thigh, abdominal-wall, leg, handle
    #[arg(default_value = "thigh")]
    model: String,
    /// Parts of strokes in the log
    #[arg(long, default_value_t = 1000, value_parser = clap::value_parser!(u16).range(1..=5000))]
    cuts: u16,
}

/// Elapsed times of a join, ms.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub struct Join {
    /// Operations that it repeats.
    pub operations: usize,
    /// A replica of the uncut model.
    pub model_ms: f64,
    /// The snapshot.
    pub restore_ms: f64,
    /// The operations, and the solver of the topology after them.
    pub repeat_ms: f64,
    /// The undo of the last stroke, on the cut worker.
    pub undo_ms: f64,
}

#[derive(Debug, Clone, Serialize)]
pub struct LateJoinReport {
    pub nodes: usize,
    pub cuts: usize,
    /// Bytes of the latest snapshot.
    pub snapshot_bytes: usize,
    /// Longest time of a snapshot at the server, ms.
    pub snapshot_ms: f64,
    pub from_snapshot: Join,
    pub from_log: Join,
    pub undo: UndoOfAll,
}

/// The undo of all strokes at the server, with its solver.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub struct UndoOfAll {
    pub strokes: usize,
    /// Times of the undos on the cut thread, ms.
    pub p50_ms: f64,
    pub max_ms: f64,
    /// Times in which a tissue adopts them, ms.
    pub adopt_p50_ms: f64,
    pub adopt_max_ms: f64,
    /// Resident memory without a cut, with all cuts and after the undos, in units of 1,048,576 bytes.
    pub uncut_mb: Option<f64>,
    pub cut_mb: Option<f64>,
    pub undone_mb: Option<f64>,
    /// Whether the hash is that of the uncut topology.
    pub is_uncut: bool,
}

impl Benchmark for LateJoin {
    type Report = LateJoinReport;

    fn measure(&self, progress: &mut OnStage<'_>) -> Result<LateJoinReport, String> {
        let model = TestModel::in_memory(&self.model, progress)?;
        progress("making the cuts");
        let mut session = Session::new(&model);
        session.cut(usize::from(self.cuts))?;
        let mut report = LateJoinReport {
            nodes: session.topology().node_count(),
            cuts: session.log.len(),
            snapshot_bytes: session
                .snapshot
                .as_ref()
                .map_or(0, |(_, bytes)| bytes.len()),
            snapshot_ms: session.snapshot_ms,
            from_snapshot: Join::default(),
            from_log: Join::default(),
            undo: UndoOfAll::default(),
        };
        let undone = session.undo()?;
        progress("taking back all strokes");
        report.undo = session.undo_all();
        progress("joining");
        report.from_snapshot = session.join(&model, true, &undone)?;
        report.from_log = session.join(&model, false, &undone)?;
        Ok(report)
    }
}

/// The server's side.
struct Session {
    tissue: Tissue,
    preparer: CutPreparer,
    memory: [Option<f64>; 2],
    log: Vec<Operation>,
    /// The latest snapshot and its version.
    snapshot: Option<(u32, Vec<u8>)>,
    snapshot_ms: f64,
}

impl Session {
    fn new(model: &Arc<Model>) -> Self {
        let tissue = Tissue::new(Arc::clone(model));
        Self {
            preparer: tissue.preparer(),
            tissue,
            memory: [resident_mb(), None],
            log: Vec::new(),
            snapshot: None,
            snapshot_ms: 0.0,
        }
    }

    fn topology(&self) -> &Arc<Topology> {
        self.preparer.topology()
    }

    fn cut(&mut self, wanted: usize) -> Result<(), String> {
        let location = ToolLocation::find(self.topology())?;
        let apart = ROWS * location.spacing_m;
        let rows = (REACH_M / apart) as i32;
        for direction in 0..DIRECTIONS {
            let turn = std::f64::consts::PI * direction as f64 / DIRECTIONS as f64;
            for row in -rows..=rows {
                let across = apart * (f64::from(row) + 0.3);
                let depth_m = DEPTH_M + DEEPER_M * direction as f64;
                self.stroke(&location, turn, across, depth_m, wanted);
                if self.log.len() == wanted {
                    self.memory[1] = resident_mb();
                    return Ok(());
                }
            }
        }
        let made = self.log.len();
        Err(format!(
            "the model has room for only {made} of {wanted} cuts"
        ))
    }

    /// One stroke in parts; a part that parts nothing begins the next one, as in the room.
    fn stroke(
        &mut self,
        location: &ToolLocation,
        turn: f64,
        across: f64,
        depth_m: f64,
        wanted: usize,
    ) {
        let began = ServerTime::from_micros(self.log.len() as i64);
        let (mut points, mut joins) = (Vec::new(), false);
        let steps = (2.0 * REACH_M / STEP_M) as usize;
        for step in 0..=steps {
            let along = STEP_M * step as f64 - REACH_M;
            let [a, b] = [
                across * turn.cos() + along * turn.sin(),
                along * turn.cos() - across * turn.sin(),
            ];
            let tip = location.surface(a, b).at - location.normal * depth_m;
            points.push(BladePoint {
                tip_m: tip.into(),
                axis: location.normal.into(),
                depth_m: depth_m + OUTSIDE_M,
            });
            if points.len() <= PART_STEPS {
                continue;
            }
            let part = CutStroke {
                began,
                joins,
                points: points.clone(),
                width_m: 0.0,
            };
            let stroke = tissue_stroke(SURGEON, &part);
            if let Ok(cut) = self.preparer.prepare(stroke) {
                self.tissue.succeed(cut);
                self.note(OperationKind::Cut(part));
                (points, joins) = (Vec::new(), true);
            } else if points.len() > POINTS_MAX {
                return;
            }
            if self.log.len() == wanted {
                return;
            }
        }
    }

    fn note(&mut self, kind: OperationKind) {
        let (version, hash) = (self.topology().version(), self.topology().hash());
        self.log.push(Operation {
            id: OperationId(self.log.len() as u64),
            at: ServerTime::ZERO,
            author: SURGEON,
            topology_version_before: version - 1,
            topology_version_after: version,
            hash_after: TopologyHash(hash.0),
            kind,
        });
        if self.log.len().is_multiple_of(SNAPSHOT_EVERY) {
            let began = Instant::now();
            let bytes = snapshot(self.topology(), self.preparer.history());
            self.snapshot_ms = self.snapshot_ms.max(ms(began));
            self.snapshot = Some((version, bytes));
        }
    }

    /// Takes back the last stroke; the operation is not in the log that a newcomer receives.
    fn undo(&mut self) -> Result<Operation, String> {
        let undone = self
            .preparer
            .undo()
            .ok_or("there is no cut to undo")?
            .finish();
        self.tissue.succeed(undone);
        self.note(OperationKind::Undone);
        self.log.pop().ok_or("the log is empty".to_owned())
    }

    fn undo_all(&mut self) -> UndoOfAll {
        let (mut times, mut adopted) = (Vec::new(), Vec::new());
        let mut began = Instant::now();
        while let Some(undone) = self.preparer.undo() {
            let undone = undone.finish();
            times.push(ms(began));
            began = Instant::now();
            let retired = self.tissue.succeed(undone);
            adopted.push(ms(began));
            drop(retired);
            began = Instant::now();
        }
        UndoOfAll {
            strokes: times.len(),
            p50_ms: quantile(&times, 0.5),
            max_ms: quantile(&times, 1.0),
            adopt_p50_ms: quantile(&adopted, 0.5),
            adopt_max_ms: quantile(&adopted, 1.0),
            uncut_mb: self.memory[0],
            cut_mb: self.memory[1],
            undone_mb: resident_mb(),
            is_uncut: self.topology().hash() == self.preparer.history().uncut().hash(),
        }
    }

    /// A trainee joins after all cuts, and takes back the last stroke.
    fn join(&self, model: &Arc<Model>, late: bool, undone: &Operation) -> Result<Join, String> {
        let snapshot = self.snapshot.as_ref().filter(|_| late);
        let covered = snapshot.map_or(0, |(version, _)| *version as usize);
        let now = ClientTime::ZERO;
        let began = Instant::now();
        let mut site = Site::new(&self.welcome(snapshot), Arc::clone(model), None);
        let model_ms = ms(began);
        let began = Instant::now();
        let mut tell = |event| site.handle_event(event, now).map_err(|e| e.to_string());
        if let Some((_, bytes)) = snapshot {
            tell(ClientEvent::Snapshot(bytes.clone()))?;
        }
        let restore_ms = ms(began);
        let began = Instant::now();
        for operation in &self.log[covered..] {
            tell(ClientEvent::Operation(operation.clone()))?;
        }
        tell(ClientEvent::CaughtUp)?;
        let repeat_ms = ms(began);
        if let Some(why) = site.poll_resync() {
            return Err(format!("the replica differs: {why}"));
        }
        let (mut prefetch, _view) = site.detach().ok_or("the site gives no cut worker")?;
        let began = Instant::now();
        prefetch.order(CutOrder::Make(undone.clone()));
        // It compares the hash with the server's.
        prefetch.work().map_err(|e| e.to_string())?;
        Ok(Join {
            operations: self.log.len() - covered,
            model_ms,
            restore_ms,
            repeat_ms,
            undo_ms: ms(began),
        })
    }

    fn welcome(&self, snapshot: Option<&(u32, Vec<u8>)>) -> Welcome {
        let newest = self.log.last();
        Welcome {
            participant: ME,
            epoch: Epoch(1),
            role: Role::Trainee,
            server_time: ServerTime::ZERO,
            model: ModelInfo {
                hash: ModelHash(0),
                bytes: 0,
            },
            roster: vec![RosterEntry {
                participant: ME,
                name: "late".to_owned(),
                role: Role::Trainee,
                tool: Some(ToolDescription::probe(8e-3)),
            }],
            topology_version: newest.map_or(0, |o| o.topology_version_after),
            topology_hash: newest.map_or(TopologyHash(0), |o| o.hash_after),
            first_operation: OperationId(0),
            snapshot: snapshot.map(|(version, bytes)| SnapshotInfo {
                bytes: bytes.len() as u32,
                topology_version: *version,
            }),
            operations_so_far: self.log.len() as u64,
            compensation: CompensationSettings {
                mode: CompensationMode::Fixed,
                initial_delay_us: 0,
            },
            tick_hz: 60,
            session_started_at: None,
            resume_token: ResumeToken([0; 16]),
        }
    }
}

fn resident_mb() -> Option<f64> {
    Memory::of(std::process::id()).map(|memory| memory.resident_mb)
}

fn ms(began: Instant) -> f64 {
    began.elapsed().as_secs_f64() * 1e3
}

impl fmt::Display for LateJoinReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{} cuts, {} nodes; snapshot of {:.1} kB, taken in at most {:.1} ms",
            self.cuts,
            self.nodes,
            self.snapshot_bytes as f64 / 1e3,
            self.snapshot_ms
        )?;
        writeln!(
            f,
            "join           operations   uncut model ms   snapshot ms   operations ms   undo ms"
        )?;
        for (name, join) in [
            ("from snapshot", &self.from_snapshot),
            ("from log", &self.from_log),
        ] {
            writeln!(
                f,
                "{name:13}  {:10}  {:15.1}  {:12.1}  {:14.1}  {:8.1}",
                join.operations, join.model_ms, join.restore_ms, join.repeat_ms, join.undo_ms
            )?;
        }
        let mb = |memory: Option<f64>| memory.map_or("?".to_owned(), |mb| format!("{mb:.0}"));
        let undo = &self.undo;
        writeln!(
            f,
            "undo of all {} strokes: {:.1} ms (median), {:.1} ms (longest) on the cut thread, {:.2} and {:.2} ms in the tissue; memory {} MB uncut, {} cut, {} after; {}",
            undo.strokes,
            undo.p50_ms,
            undo.max_ms,
            undo.adopt_p50_ms,
            undo.adopt_max_ms,
            mb(undo.uncut_mb),
            mb(undo.cut_mb),
            mb(undo.undone_mb),
            if undo.is_uncut {
                "the topology is the uncut one"
            } else {
                "the topology is NOT the uncut one"
            }
        )
    }
}
