//! `bench coding`: bits per pose and per node on the wire, compared with deflate and with raw numbers.
//!
//! The hand moves at 87 mm/s rms with a tremor of 0.1 mm and rotates at about 40 degrees per second. Its
//! batches have four new 1 kHz samples and the last one before. A block of 4,096 nodes is pressed and released
//! by the solver, at 60 frames per second. Both ends know all data older than a round trip. Deflate encodes the
//! same integers as differences from the same older data, each datagram or frame independently because of loss.
//! Raw numbers have four bytes.

use std::fmt;
use std::io::Write as _;
use std::sync::Arc;

use clap::Args;
use flate2::Compression;
use flate2::write::DeflateEncoder;
use nalgebra::{UnitQuaternion, Vector3};
use palpate_protocol::datagram::{
    Body, Datagram, Displacements, Header, Memory, POSITION_STEP_M, TIME_STEP_US, Tag,
};
use palpate_protocol::{Epoch, ParticipantId, Pose, ServerTime, Span, ToolSample, ToolTrack};
use palpate_tissue::{Budget, Material, Shape, Tissue, Topology, Vec3, block};
use serde::Serialize;

use super::{Benchmark, OnStage};
use crate::hand::{Hand, HandParameters, Random};

/// New samples per batch; the last older one is repeated.
const BATCH: usize = 4;
/// 20 s of batches.
const BATCHES: usize = 5000;

/// Nodes per edge of the block, and its side, m.
const NODES: usize = 16;
const SIDE_M: f64 = 0.1;

/// Radius of the pressing disc, and its depth, m.
const DISC_M: f64 = 0.02;
const DEPTH_M: f64 = 6e-3;

/// Frames per second, and frames of the press and release.
const FRAME_HZ: i64 = 60;
const FRAMES: usize = 120;
const STEP_UM: u16 = 50;
/// Levels of deflate: the fastest and the smallest.
const LEVELS: [u32; 2] = [1, 9];
const TURN_RAD_PER_M: f64 = 8.0;

#[derive(Debug, Clone, Copy, Args)]
pub struct Coding {
    /// Round trip after which both ends know the sent data, in ms
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(i64).range(0..=400))]
    pub round_trip_ms: i64,
    /// Seed of the hand
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
}

impl Benchmark for Coding {
    type Report = CodingReport;

    fn measure(&self, _: &mut OnStage<'_>) -> Result<CodingReport, String> {
        let poses = BATCH * BATCHES;
        let motion = self.motion()?;
        let (nodes, press) = self.press()?;
        let node = press.per(nodes * FRAMES);
        Ok(CodingReport {
            round_trip_ms: self.round_trip_ms,
            seed: self.seed,
            poses,
            pose: motion.per(poses),
            motion_datagram_bytes: motion.ours as f64 / BATCHES as f64,
            nodes,
            frames: FRAMES,
            node,
            node_kbit_per_s: node.ours * nodes as f64 * FRAME_HZ as f64 / 1e3,
        })
    }
}

/// Bits per pose or node, headers included.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Bits {
    pub ours: f64,
    pub deflate_1: f64,
    pub deflate_9: f64,
    pub raw: f64,
}

#[derive(Debug, Clone, Serialize)]
pub struct CodingReport {
    pub round_trip_ms: i64,
    pub seed: u64,
    pub poses: usize,
    /// Bits per new pose: position, rotation, time, buttons.
    pub pose: Bits,
    pub motion_datagram_bytes: f64,
    pub nodes: usize,
    pub frames: usize,
    pub node: Bits,
    /// kbit/s of this project at 60 frames per second, without the overhead of QUIC.
    pub node_kbit_per_s: f64,
}

/// Total bytes per coding.
#[derive(Debug, Default)]
struct Sums {
    ours: usize,
    deflate: [usize; LEVELS.len()],
    raw: usize,
}

impl Sums {
    fn add_deflate(&mut self, bytes: &[u8]) -> Result<(), String> {
        for (sum, level) in self.deflate.iter_mut().zip(LEVELS) {
            let mut encoder = DeflateEncoder::new(Vec::new(), Compression::new(level));
            let packed = encoder.write_all(bytes).and_then(|()| encoder.finish());
            let packed = packed
                .map_err(|e| format!("deflate level {level} of {} bytes: {e}", bytes.len()))?;
            *sum += packed.len();
        }
        Ok(())
    }

    fn per(&self, items: usize) -> Bits {
        let bits = |bytes: usize| 8.0 * bytes as f64 / items as f64;
        let [deflate_1, deflate_9] = self.deflate.map(bits);
        Bits {
            ours: bits(self.ours),
            deflate_1,
            deflate_9,
            raw: bits(self.raw),
        }
    }
}

/// One direction of a connection: numbers its datagrams and receives acknowledgements one round trip later.
struct Direction {
    memory: Memory,
    sequence: u32,
    on_the_way: Vec<(ServerTime, u32)>,
    round_trip: Span,
}

impl Direction {
    fn new(round_trip_ms: i64) -> Self {
        Self {
            memory: Memory::default(),
            sequence: 0,
            on_the_way: Vec::new(),
            round_trip: Span::from_millis(round_trip_ms),
        }
    }

    fn send(&mut self, body: Body, now: ServerTime) -> Result<usize, String> {
        let (memory, round_trip) = (&mut self.memory, self.round_trip);
        self.on_the_way.retain(|(sent, sequence)| {
            let arrived = now - *sent >= round_trip;
            if arrived {
                memory.acknowledge(*sequence);
            }
            !arrived
        });
        self.sequence += 1;
        let header = Header {
            tag: Tag {
                epoch: Epoch(1),
                stream: ParticipantId(1),
            },
            sequence: self.sequence,
            generated: now,
            is_whole: false,
            acknowledged: None,
        };
        let bytes = Datagram { header, body }
            .encode(&mut self.memory)
            .map_err(|e| e.to_string())?;
        self.on_the_way.push((now, self.sequence));
        Ok(bytes.len())
    }
}

/// A sample as seven integers: time, position, rotation vector.
fn integers(sample: &ToolSample) -> [i32; 7] {
    let mut out = [0; 7];
    out[0] = (sample.time.as_micros() / TIME_STEP_US) as i32;
    let [i, j, k, w] = sample.pose.orientation;
    let turn = UnitQuaternion::new_normalize(nalgebra::Quaternion::new(w, i, j, k)).scaled_axis();
    for axis in 0..3 {
        out[1 + axis] = (sample.pose.position_m[axis] / POSITION_STEP_M).round() as i32;
        // A quaternion component is half an angle, in the quantisation of the codec.
        out[4 + axis] = (0.5 * turn[axis] / 2e-4).round() as i32;
    }
    out
}

impl Coding {
    fn motion(&self) -> Result<Sums, String> {
        let place = Random::new(HandParameters::default(), self.seed);
        let turn = Random::new(HandParameters::default(), self.seed.wrapping_add(1));
        let sample = |ms: i64| {
            let t_s = ms as f64 * 1e-3;
            let axis = Vector3::from(turn.at(t_s).position_m) * TURN_RAD_PER_M;
            let q = UnitQuaternion::from_scaled_axis(axis);
            ToolSample {
                time: ServerTime::from_micros(1000 * ms),
                pose: Pose {
                    orientation: [q.i, q.j, q.k, q.w],
                    ..place.at(t_s)
                },
                ..ToolSample::default()
            }
        };
        let mut direction = Direction::new(self.round_trip_ms);
        let mut sums = Sums::default();
        let behind = (self.round_trip_ms / BATCH as i64 + 1) * BATCH as i64;
        for batch in 0..BATCHES as i64 {
            let newest = 1000 + batch * BATCH as i64;
            let samples: Vec<ToolSample> = (newest - BATCH as i64..=newest).map(sample).collect();
            let known = integers(&sample(newest - behind));
            let differences = samples.iter().flat_map(|s| {
                let now = integers(s);
                (0..7).flat_map(move |i| (now[i] - known[i]).to_le_bytes())
            });
            sums.add_deflate(&differences.collect::<Vec<u8>>())?;
            // Time, position, quaternion; buttons in one byte.
            sums.raw += samples.len() * (4 * 8 + 1);
            let track = ToolTrack {
                participant: ParticipantId(1),
                samples,
                ..ToolTrack::default()
            };
            let now = ServerTime::from_micros(1000 * newest);
            sums.ours += direction.send(Body::Motion(vec![track]), now)?;
        }
        Ok(sums)
    }

    /// The number of nodes, and the bytes of all frames.
    fn press(&self) -> Result<(usize, Sums), String> {
        let spacing = SIDE_M / (NODES as f64 - 1.0);
        let material = Material {
            young_pa: 10e3,
            ..Material::default()
        };
        let model = block([NODES - 1; 3], spacing, &material, 1);
        let topology = Topology::new(Arc::new(model));
        let top = Vec3::new(0.5 * SIDE_M, 0.5 * SIDE_M, SIDE_M);
        let under = |&node: &u32| {
            let d = topology.rest(node) - top;
            d.z.abs() < 0.1 * spacing && d.norm() <= DISC_M
        };
        let nodes = topology.node_count();
        let disc: Vec<u32> = (0..nodes as u32).filter(under).collect();
        let mut tissue = Tissue::at_rest(topology);
        let mut direction = Direction::new(self.round_trip_ms);
        let mut sums = Sums::default();
        let mut sent: Vec<Vec<i32>> = Vec::new();
        for frame in 0..FRAMES {
            let phase = frame as f64 / (FRAMES - 1) as f64;
            let depth = DEPTH_M * (std::f64::consts::PI * phase).sin();
            for &node in &disc {
                tissue.hold(node, Vec3::z() * -depth);
            }
            tissue.step(&[], Budget::new(30, 1e-3));
            let now = ServerTime::from_micros(1_000_000 * (FRAME_HZ + frame as i64) / FRAME_HZ);
            let whole = Displacements {
                waiting: 0,
                step_um: STEP_UM,
                topology_version: 0,
                view_time: now,
                nodes: displacements(tissue.shape()),
            };
            for piece in whole.pieces() {
                sums.ours += direction.send(Body::Displacements(piece), now)?;
            }
            let step = f64::from(STEP_UM) * 1e-6;
            let round = |x: &f64| (x / step).round() as i32;
            let steps: Vec<i32> = (tissue.shape().displacement.iter())
                .flat_map(|d| [round(&d.x), round(&d.y), round(&d.z)])
                .collect();
            let frames_behind = (self.round_trip_ms * FRAME_HZ / 1000 + 1) as usize;
            let known = frame.checked_sub(frames_behind).map(|i| &sent[i]);
            let difference = |(i, x): (usize, &i32)| {
                let before = known.map_or(0, |known| known[i]);
                ((x - before) as i16).to_le_bytes()
            };
            let bytes: Vec<u8> = steps.iter().enumerate().flat_map(difference).collect();
            sums.add_deflate(&bytes)?;
            sums.raw += nodes * 3 * 4;
            sent.push(steps);
        }
        Ok((nodes, sums))
    }
}

fn displacements(shape: &Shape) -> Vec<(u32, [f32; 3])> {
    let nodes = shape.displacement.iter().enumerate();
    nodes
        .map(|(n, d)| (n as u32, [d.x as f32, d.y as f32, d.z as f32]))
        .collect()
}

impl fmt::Display for CodingReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "round trip {} ms; {} poses of a hand (seed {}), {} frames of {} nodes at {STEP_UM} µm",
            self.round_trip_ms, self.poses, self.seed, self.frames, self.nodes
        )?;
        writeln!(f, "bits          ours deflate1 deflate9      raw")?;
        for (name, b) in [("per pose", self.pose), ("per node", self.node)] {
            writeln!(
                f,
                "{name:<9} {:>8.2} {:>8.2} {:>8.2} {:>8.2}",
                b.ours, b.deflate_1, b.deflate_9, b.raw
            )?;
        }
        write!(
            f,
            "a datagram of motion has {:.1} B; a view of all nodes at {FRAME_HZ} Hz takes {:.0} kbit/s",
            self.motion_datagram_bytes, self.node_kbit_per_s
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codec_beats_deflate_and_half_of_raw() {
        let run = Coding {
            round_trip_ms: 50,
            seed: 1,
        };
        let report = run.measure(&mut |_| ()).unwrap();
        for bits in [report.pose, report.node] {
            assert!(bits.deflate_1 > 0.0 && bits.deflate_9 > 0.0, "{report}");
            assert!(bits.ours < bits.deflate_9.min(bits.deflate_1), "{report}");
            assert!((0.0..0.5 * bits.raw).contains(&bits.ours), "{report}");
        }
    }
}
