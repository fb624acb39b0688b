//! Statistics over many sessions: distances of shapes and errors of forces, over all of the time and outside
//! [stalls](Stalls) of the network. The limits hold outside; within stalls the own force must stay.

use palpate_client::Recording;
use serde_json::{Value, json};

use crate::bench::quantile_of_sorted;
use crate::disagreement::{Disagreement, DisagreementPoint, each_node};
use crate::dropout::Dropouts;
use crate::force_error::{ForcePoint, difference, minus, norm, over_script};
use crate::histogram::StepHistogram;
use crate::network::Profile;
use crate::simulated_session::{BytesPerSecond, SessionResult};
use crate::stalls::Stalls;

const SHAPE_P95_MM: f64 = 0.1;
const FORCE_RMS: f64 = 0.05;

/// Largest change of a force within 4 ms of a stall, N.
const FORCE_STEP_N: f64 = 0.5;

#[derive(Debug, Clone, Default)]
struct ForceErrors {
    /// Sums of `|F - F_ref|²` and `|F_ref|²`, N².
    off: f64,
    size: f64,
    /// `|F - F_ref|`, N.
    errors: Vec<f32>,
}

impl ForceErrors {
    fn add(&mut self, [off, size]: [f64; 2]) {
        self.off += off * off;
        self.size += size * size;
        self.errors.push(off as f32);
    }

    fn join(mut self, mut other: Self) -> Self {
        self.errors.append(&mut other.errors);
        Self {
            off: self.off + other.off,
            size: self.size + other.size,
            ..self
        }
    }

    fn rms(&self) -> f64 {
        (self.off / self.size).sqrt()
    }

    /// The 95th percentile of the error during contact, relative to the rms force.
    fn p95(&mut self) -> f64 {
        self.errors.sort_unstable_by(f32::total_cmp);
        let p95 = quantile_of_sorted(&self.errors, 0.95).map_or(f64::NAN, f64::from);
        p95 / (self.size / self.errors.len() as f64).sqrt()
    }
}

/// Agreement of shapes, and of forces with the replay of the same hand motions.
#[derive(Debug, Clone, Default)]
struct Agreement {
    /// Distances in mm, in steps of 0.5 µm.
    apart: StepHistogram<2000>,
    felt: ForceErrors,
}

impl Agreement {
    fn join(self, other: Self) -> Self {
        Self {
            apart: self.apart.join(&other.apart),
            felt: self.felt.join(other.felt),
        }
    }

    fn row(&mut self) -> Value {
        let (p50, p95) = (self.apart.quantile(0.5), self.apart.quantile(0.95));
        json!({
            "shape_disagreement_mm": { "p50": p50, "p95": p95, "max": self.apart.max },
            "force_error_rms": self.felt.rms(),
            "force_error_p95": self.felt.p95(),
        })
    }
}

/// The own forces during stalls.
#[derive(Debug, Clone, Copy, Default)]
struct Stalled {
    /// Sessions without times of packets: their stalls are unknown.
    unknown: u64,
    us: i64,
    of_us: i64,
    dropouts: usize,
    force_step_max_n: f64,
}

impl Stalled {
    /// Adds the course of a force, and the spans in s in which it dropped out.
    fn add(&mut self, stalls: &Stalls, course: &[ForcePoint], spans_s: &[(f64, f64)], began: i64) {
        let us = |t_s: f64| began + (t_s * 1e6) as i64;
        let within = |span: &&(f64, f64)| stalls.meet(us(span.0), us(span.1));
        self.dropouts += spans_s.iter().filter(within).count();
        for pair in course
            .windows(2)
            .filter(|pair| stalls.contain(us(pair[1].t_s)))
        {
            let step = norm(minus(pair[1].force_n, pair[0].force_n));
            self.force_step_max_n = self.force_step_max_n.max(step);
        }
    }

    fn join(self, other: Self) -> Self {
        Self {
            unknown: self.unknown + other.unknown,
            us: self.us + other.us,
            of_us: self.of_us + other.of_us,
            dropouts: self.dropouts + other.dropouts,
            force_step_max_n: self.force_step_max_n.max(other.force_step_max_n),
        }
    }

    /// Null if the stalls of a session are unknown.
    fn row(&self) -> Value {
        if self.unknown > 0 {
            return Value::Null;
        }
        json!({
            "share": self.us as f64 / self.of_us.max(1) as f64,
            "dropouts": self.dropouts,
            "force_step_max_n": self.force_step_max_n,
        })
    }
}

pub(super) struct SessionRecord {
    pub(super) recordings: [Recording; 2],
    pub(super) hashes_equal: bool,
    /// `None` if not measured.
    pub(super) bytes_per_s: Option<BytesPerSecond>,
    /// `None` if unknown; the limits then hold at all times.
    pub(super) stalls: Option<Stalls>,
    pub(super) troubles: Vec<String>,
}

impl TryFrom<SessionResult> for SessionRecord {
    type Error = String;

    fn try_from(result: SessionResult) -> Result<Self, String> {
        let hashes_equal = result.hashes_equal();
        let recordings = <[Recording; 2]>::try_from(result.recordings);
        Ok(Self {
            recordings: recordings.map_err(|r| format!("{} recordings of two", r.len()))?,
            hashes_equal,
            bytes_per_s: Some(result.bytes_per_s),
            stalls: Some(result.stalls),
            troubles: result.troubles,
        })
    }
}

#[derive(Debug, Clone, Default)]
pub(super) struct Tally {
    sessions: u64,
    whole: Agreement,
    outside: Agreement,
    stalled: Stalled,
    /// Dropouts of own forces at any time.
    dropouts: usize,
    /// Errors against a run of the scripts without a network.
    scripted: ForceErrors,
    equal: u64,
    /// Sum over the measured sessions.
    bytes: Option<BytesPerSecond>,
    troubles: Vec<String>,
    /// Disagreement over time of the first seed.
    pub(super) disagreement: Vec<DisagreementPoint>,
}

impl Tally {
    /// The statistics of one session. `references` are two references without a network: the replay of the same
    /// hand motions, and the run of the scripts. Without them forces are not compared.
    pub(super) fn of(
        session: SessionRecord,
        references: Option<[&[Vec<ForcePoint>; 2]; 2]>,
        is_first: bool,
    ) -> Self {
        let mut tally = Self {
            sessions: 1,
            equal: u64::from(session.hashes_equal),
            bytes: session.bytes_per_s,
            troubles: session.troubles,
            ..Self::default()
        };
        let [a, b] = &session.recordings;
        tally.stalled.unknown = u64::from(session.stalls.is_none());
        let stalls = session.stalls.unwrap_or_default();
        each_node(a, b, |t, mm| {
            tally.whole.apart.add(f64::from(mm));
            if !stalls.contain(t) {
                tally.outside.apart.add(f64::from(mm));
            }
        });
        for recording in [a, b] {
            let ends = recording.script_started_us.zip(recording.views.last());
            if let Some((from, last)) = ends {
                tally.stalled.us += stalls.within_us(from, last.shown_us);
                tally.stalled.of_us += last.shown_us - from;
            }
        }
        if is_first {
            tally.disagreement = Disagreement::between(&[a, b]).over_time;
        }
        let Some([same_hands, scripted]) = references else {
            return tally;
        };
        for (k, recording) in session.recordings.iter().enumerate() {
            let Some(began) = recording.script_started_us else {
                continue;
            };
            let course = over_script(&recording.haptic, began);
            for (t_s, off, size) in difference(&course, &same_hands[k]) {
                tally.whole.felt.add([off, size]);
                if !stalls.contain(began + (t_s * 1e6) as i64) {
                    tally.outside.felt.add([off, size]);
                }
            }
            for (_, off, size) in difference(&course, &scripted[k]) {
                tally.scripted.add([off, size]);
            }
            let dropouts = Dropouts::between(&course, &same_hands[k]);
            let spans_s = dropouts.map(|d| d.spans_s).unwrap_or_default();
            tally.dropouts += spans_s.len();
            tally.stalled.add(&stalls, &course, &spans_s, began);
        }
        tally
    }

    pub(super) fn join(mut self, mut other: Self) -> Self {
        self.whole = self.whole.join(other.whole);
        self.outside = self.outside.join(other.outside);
        self.stalled = self.stalled.join(other.stalled);
        self.scripted = self.scripted.join(other.scripted);
        self.troubles.append(&mut other.troubles);
        Self {
            sessions: self.sessions + other.sessions,
            dropouts: self.dropouts + other.dropouts,
            equal: self.equal + other.equal,
            bytes: match (self.bytes, other.bytes) {
                (Some(a), Some(b)) => Some(BytesPerSecond {
                    up: a.up + b.up,
                    down: a.down + b.down,
                }),
                (one, other) => one.or(other),
            },
            disagreement: if self.disagreement.is_empty() {
                other.disagreement
            } else {
                self.disagreement
            },
            ..self
        }
    }

    pub(super) fn row(&mut self, profile: &Profile) -> Value {
        let n = self.sessions.max(1) as f64;
        let equal = self.equal == self.sessions;
        let missed = self.missed(profile);
        let mut row = self.whole.row();
        row["profile"] = json!(profile.name);
        row["seeds"] = json!(self.sessions);
        row["force_error_rms_scripted"] = json!(self.scripted.rms());
        row["outside_stalls"] = self.outside.row();
        row["stalls"] = self.stalled.row();
        row["dropouts"] = json!(self.dropouts);
        row["hashes_equal"] = json!(equal);
        row["bytes_per_s"] = json!(
            self.bytes
                .map(|b| json!({ "up": b.up / n, "down": b.down / n }))
        );
        row["troubles"] = json!(self.troubles);
        row["ok"] = json!(missed.is_empty());
        row["missed"] = json!(missed);
        row
    }

    fn missed(&self, profile: &Profile) -> Vec<String> {
        let mut missed = Vec::new();
        let mut miss = |what: String| missed.push(format!("{}: {what}", profile.name));
        let (shape_p95_mm, force_rms) =
            (self.outside.apart.quantile(0.95), self.outside.felt.rms());
        if shape_p95_mm.is_nan() {
            miss("no time outside stalls was left for comparison".to_owned());
        } else if shape_p95_mm > SHAPE_P95_MM {
            miss(format!(
                "shapes differ by {shape_p95_mm:.3} mm (p95) outside stalls, limit {SHAPE_P95_MM}"
            ));
        }
        let (percent, most) = (force_rms * 100.0, FORCE_RMS * 100.0);
        if force_rms.is_nan() {
            miss("no force was available for comparison".to_owned());
        } else if force_rms > FORCE_RMS {
            miss(format!(
                "forces differ by {percent:.1} % (rms) outside stalls, limit {most:.0} %"
            ));
        }
        if self.stalled.dropouts > 0 {
            miss(format!(
                "{} dropouts of the force in stalls",
                self.stalled.dropouts
            ));
        }
        let step_n = self.stalled.force_step_max_n;
        if step_n > FORCE_STEP_N {
            miss(format!(
                "a force step of {step_n:.2} N in a stall, limit {FORCE_STEP_N}"
            ));
        }
        if self.equal < self.sessions {
            let (others, all) = (self.sessions - self.equal, self.sessions);
            miss(format!(
                "topologies differ at the end of {others} of {all} sessions"
            ));
        }
        if let [first, ..] = &self.troubles[..] {
            let n = self.troubles.len();
            miss(format!("{n} errors; the first: {first}"));
        }
        missed
    }
}
