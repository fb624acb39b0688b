//! Statistics over many sessions: distances of shapes and errors of forces.

use palpate_client::Recording;
use serde_json::{Value, json};

use crate::bench::quantile_of_sorted;
use crate::disagreement::{Disagreement, DisagreementPoint, each_node};
use crate::force_error::{ForcePoint, difference, over_script};
use crate::histogram::StepHistogram;
use crate::network::Profile;
use crate::simulated_session::{BytesPerSecond, SessionResult};

const SHAPE_P95_MM: f64 = 0.1;
const FORCE_RMS: f64 = 0.05;

#[derive(Debug, Clone, Default)]
struct ForceErrors {
    /// Sums of `|F - F_ref|²` and `|F_ref|²`, N².
    off: f64,
    size: f64,
    /// `|F - F_ref|`, N.
    errors: Vec<f32>,
}

impl ForceErrors {
    fn add(&mut self, recording: &Recording, reference: &[ForcePoint]) {
        let Some(began) = recording.script_started_us else {
            return;
        };
        for (off, size) in difference(&over_script(&recording.haptic, began), reference) {
            self.off += off * off;
            self.size += size * size;
            self.errors.push(off as f32);
        }
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

pub(super) struct SessionRecord {
    pub(super) recordings: [Recording; 2],
    pub(super) hashes_equal: bool,
    /// `None` if not measured.
    pub(super) bytes_per_s: Option<BytesPerSecond>,
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
            troubles: result.troubles,
        })
    }
}

#[derive(Debug, Clone, Default)]
pub(super) struct Tally {
    sessions: u64,
    /// Distances in mm, in steps of 0.5 µm.
    apart: StepHistogram<2000>,
    /// Errors against the replay of the same hand motions.
    felt: ForceErrors,
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
        each_node(a, b, |mm| tally.apart.add(f64::from(mm)));
        if is_first {
            tally.disagreement = Disagreement::between(&[a, b]).over_time;
        }
        let Some([same_hands, scripted]) = references else {
            return tally;
        };
        for (k, recording) in session.recordings.iter().enumerate() {
            tally.felt.add(recording, &same_hands[k]);
            tally.scripted.add(recording, &scripted[k]);
        }
        tally
    }

    pub(super) fn join(mut self, mut other: Self) -> Self {
        self.apart = self.apart.join(&other.apart);
        self.felt = self.felt.join(other.felt);
        self.scripted = self.scripted.join(other.scripted);
        self.troubles.append(&mut other.troubles);
        Self {
            sessions: self.sessions + other.sessions,
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
        let (p50, p95) = (self.apart.quantile(0.5), self.apart.quantile(0.95));
        let equal = self.equal == self.sessions;
        let (rms, force_p95) = (self.felt.rms(), self.felt.p95());
        let missed = self.missed(profile, p95, rms);
        json!({
            "profile": profile.name,
            "seeds": self.sessions,
            "shape_disagreement_mm": { "p50": p50, "p95": p95, "max": self.apart.max },
            "force_error_rms": rms,
            "force_error_p95": force_p95,
            "force_error_rms_scripted": self.scripted.rms(),
            "hashes_equal": equal,
            "bytes_per_s": self.bytes.map(|b| json!({ "up": b.up / n, "down": b.down / n })),
            "troubles": self.troubles,
            "missed": missed,
            "ok": missed.is_empty(),
        })
    }

    fn missed(&self, profile: &Profile, shape_p95_mm: f64, force_rms: f64) -> Vec<String> {
        let mut missed = Vec::new();
        let mut miss = |what: String| missed.push(format!("{}: {what}", profile.name));
        if shape_p95_mm > SHAPE_P95_MM {
            miss(format!(
                "shapes differ by {shape_p95_mm:.3} mm (p95), limit {SHAPE_P95_MM}"
            ));
        }
        let (percent, most) = (force_rms * 100.0, FORCE_RMS * 100.0);
        if force_rms.is_nan() {
            miss("no force was available for comparison".to_owned());
        } else if force_rms > FORCE_RMS {
            miss(format!(
                "forces differ by {percent:.1} % (rms), limit {most:.0} %"
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
