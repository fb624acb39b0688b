//! The product's delay controller beside controllers from the literature, over several networks.

use std::sync::Arc;

use serde_json::{Value, json};

use super::table::Column;
use super::{Bench, Outcome, Table};
use crate::alignment::{Alignment, Baseline, Figures, Mode};
use crate::hand::Hand;
use crate::network::Profile;

/// Networks without jitter steps, with them, and with bursts; recorded networks are added.
const NETWORKS: [&str; 5] = ["steps", "gamma", "transatlantic", "bursts", "lte"];

const COLUMNS: &[Column] = &[
    ("network", "profile", 1.0),
    ("controller", "controller", 1.0),
    ("rms_mm", "disagreement_mm.rms", 1.0),
    ("p95_mm", "disagreement_mm.p95", 1.0),
    ("max_mm", "disagreement_mm.max", 1.0),
    ("mean_delay_ms", "compensation_ms.mean", 1.0),
    ("over_smallest_safe", "lag_over_smallest_safe", 1.0),
    (
        "fixed_at_equal_lag_rms_mm",
        "fixed_at_equal_lag_mm.rms",
        1.0,
    ),
];

fn row(alignment: &Alignment, mode: Mode, name: &str, safe_ms: Option<u32>) -> Value {
    let figures = alignment.figures(mode);
    let mean_ms = figures.compensation_ms.mean;
    let equal_lag = alignment.figures(Mode::Fixed(mean_ms.round() as u32));
    let Figures {
        disagreement_mm,
        compensation_ms,
        ..
    } = figures;
    json!({
        "profile": alignment.profile.name,
        "controller": name,
        "disagreement_mm": disagreement_mm,
        "compensation_ms": compensation_ms,
        "lag_over_smallest_safe": safe_ms.filter(|ms| *ms > 0).map(|ms| mean_ms / f64::from(ms)),
        "fixed_at_equal_lag_mm": equal_lag.disagreement_mm,
    })
}

pub(super) fn run(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let profiles = if let Some(profile) = &bench.inputs.profile {
        vec![profile.clone()]
    } else {
        let named = NETWORKS.into_iter().map(Profile::named);
        let recorded = Profile::recorded().into_iter();
        let recorded = recorded.map(|file| Profile::parse(&file.to_string_lossy()));
        named.chain(recorded).collect::<Result<_, _>>()?
    };
    let motion = bench.inputs.motion.clone();
    let mut rows = Vec::new();
    for (k, profile) in profiles.iter().enumerate() {
        (bench.progress)(&profile.name, k as f64 / profiles.len() as f64);
        let alignment = Alignment {
            profile: profile.clone(),
            seed: bench.seed(),
            motion: motion.clone().map(|motion| -> Arc<dyn Hand> { motion }),
        };
        let safe_ms = bench.inputs.safe_delays.of(&alignment, &mut |_| {});
        rows.push(row(&alignment, Mode::Adaptive, "Palpate", safe_ms));
        let baselines =
            Baseline::ALL.map(|b| row(&alignment, Mode::Baseline(b), b.name(), safe_ms));
        rows.extend(baselines);
    }
    Ok(Outcome {
        caption: "Two sites align a part with an adaptive playout delay by three controllers: disagreement, mean delay \
                  relative to the smallest safe fixed delay, and the disagreement of a fixed delay of equal mean."
            .to_owned(),
        tables: vec![("atc-controllers".to_owned(), Table::of_objects(&rows, COLUMNS))],
        figures: json!({ "experiment": "atc-controllers", "seed": bench.seed(), "rows": rows }),
        ..Outcome::default()
    })
}
