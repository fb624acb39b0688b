//! Two sites align a shared part with and without artificial time compensation (figs 7.24 to 7.28).

use std::sync::Arc;

use serde_json::{Value, json};

use super::safe_delays::SafeDelays;
use super::{Bench, Outcome, Table};
use crate::alignment::two_sites::Moment;
use crate::alignment::{Alignment, Figures, Mode};
use crate::chart::{BLUE, Chart, Line, ORANGE, Panel};
use crate::hand::Hand;
use crate::network::Profile;

const PROFILE: &str = "transatlantic";

/// Approximate number of sessions per seed: the search for a safe delay, then the comparison.
const SESSIONS: f64 = 12.0;

/// Drawn seconds of a quantity that changes with each packet; a longer plot would be a solid bar.
const DRAWN_S: f64 = 1.0;

pub(super) fn none(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    aligned(bench, "none")
}

pub(super) fn fixed(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    aligned(bench, "fixed")
}

pub(super) fn adaptive(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    aligned(bench, "adaptive")
}

/// Runs an alignment with server-side prediction, an alternative interpretation of the source.
pub(super) fn predicted(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    aligned(bench, "predicted")
}

fn alignment(bench: &Bench<'_>, profile: &Profile, seed: u64) -> Alignment {
    let motion = bench.inputs.motion.clone();
    Alignment {
        profile: profile.clone(),
        seed,
        motion: motion.map(|motion| -> Arc<dyn Hand> { motion }),
    }
}

/// Rejects a network without enough arrivals: views that never received samples would show no disagreement.
fn refuse_silence(alignment: &Alignment, network: &str) -> Result<(), String> {
    let arrivals = alignment.arrivals();
    if arrivals.are_enough() {
        return Ok(());
    }
    Err(format!(
        "{} of {} samples arrived on {network}, too few to compare the sites; choose a network with less delay and loss",
        arrivals.arrived, arrivals.of
    ))
}

struct SeedResult {
    safe_ms: Option<u32>,
    moments: Vec<Moment>,
    figures: Figures,
    none_rms_mm: f64,
    /// Results with a fixed delay equal to this mode's mean.
    equal_lag: Figures,
    /// Results of the default delay rule; only in prediction mode.
    delayed: Option<Figures>,
    ahead_ms: f64,
}

impl SeedResult {
    fn of(
        alignment: &Alignment,
        name: &str,
        network: &str,
        safe_delays: &SafeDelays,
        report: &mut dyn FnMut(&str, f64),
    ) -> Result<Self, String> {
        refuse_silence(alignment, network)?;
        let mut tried = 0.0;
        let safe_ms = safe_delays.of(alignment, &mut |ms| {
            report(
                &format!("trying a fixed delay of {ms} ms"),
                tried / SESSIONS,
            );
            tried = f64::min(tried + 1.0, SESSIONS - 1.0);
        });
        report("aligning", tried / SESSIONS);
        let mode = match name {
            "none" => Mode::None,
            "fixed" => Mode::Fixed(safe_ms.ok_or_else(|| {
                format!(
                    "on the network {network} no fixed delay up to 1 s keeps two sites within 0.1 mm for 95 \
                     % of the time; choose a network with less loss, or atc-adaptive",
                )
            })?),
            "predicted" => Mode::Predicted,
            _ => Mode::Adaptive,
        };
        let moments = alignment.moments(mode);
        let figures = Figures::of(&moments);
        let mean_ms = figures.compensation_ms.mean.round() as u32;
        let ahead_ms =
            moments.iter().map(|m| m.ahead_ms).sum::<f64>() / moments.len().max(1) as f64;
        Ok(Self {
            safe_ms,
            moments,
            ahead_ms,
            figures,
            none_rms_mm: alignment.figures(Mode::None).disagreement_mm.rms,
            equal_lag: alignment.figures(Mode::Fixed(mean_ms)),
            delayed: (mode == Mode::Predicted).then(|| alignment.figures(Mode::Adaptive)),
        })
    }
}

/// Figures of one seed, or of several: root of the mean square, worst 95th percentile and maximum, sums of counts.
fn combined(results: &[SeedResult], name: &str, network: &str, first_seed: u64) -> Value {
    let n = results.len().max(1) as f64;
    let most = |of: fn(&SeedResult) -> f64| results.iter().map(of).fold(0.0, f64::max);
    let sum = |of: fn(&SeedResult) -> f64| results.iter().map(of).sum::<f64>();
    let count = |of: fn(&SeedResult) -> u64| results.iter().map(of).sum::<u64>();
    let rms = |of: fn(&SeedResult) -> f64| {
        let squares = results.iter().map(|s| of(s).powi(2)).sum::<f64>();
        (squares / n).sqrt()
    };
    let apart = rms(|s| s.figures.disagreement_mm.rms);
    let mean_ms = sum(|s| s.figures.compensation_ms.mean) / n;
    let safe: Option<Vec<u32>> = results.iter().map(|s| s.safe_ms).collect();
    let safe_mean_ms = safe
        .as_ref()
        .map(|s| s.iter().map(|&ms| f64::from(ms)).sum::<f64>() / n);
    let mut value = json!({
        "mode": name,
        "profile": network,
        "seed": first_seed,
        "disagreement_mm": {
            "rms": apart,
            "p95": most(|s| s.figures.disagreement_mm.p95),
            "max": most(|s| s.figures.disagreement_mm.max),
        },
        "compensation_ms": { "mean": mean_ms, "p95": most(|s| s.figures.compensation_ms.p95) },
        "smallest_safe_fixed_ms": safe.and_then(|s| s.into_iter().max()),
        "corrections_over_1mm": count(|s| s.figures.corrections_over_1mm),
        "stale_ticks": count(|s| s.figures.stale_ticks),
        "lag_over_smallest_safe": safe_mean_ms.filter(|&ms| ms > 0.0).map(|ms| mean_ms / ms),
        "times_nearer_than_none": rms(|s| s.none_rms_mm) / apart.max(f64::MIN_POSITIVE),
        "fixed_at_equal_lag_mm": {
            "rms": rms(|s| s.equal_lag.disagreement_mm.rms),
            "p95": most(|s| s.equal_lag.disagreement_mm.p95),
            "max": most(|s| s.equal_lag.disagreement_mm.max),
        },
    });
    match results {
        [one] => {
            if let Some(delayed) = &one.delayed {
                value["ahead_ms"] = json!(one.ahead_ms);
                value["adaptive"] = json!({
                    "disagreement_mm": delayed.disagreement_mm,
                    "compensation_ms": delayed.compensation_ms,
                });
            }
        }
        all => {
            let each = (first_seed..).zip(all.chunks(1));
            let each = each.map(|(seed, one)| combined(one, name, network, seed));
            value["each"] = each.collect();
            value["seeds"] = json!(all.len());
        }
    }
    value
}

fn aligned(bench: &mut Bench<'_>, name: &str) -> Result<Outcome, String> {
    let profile = bench.profile_or(PROFILE)?;
    let seeds = bench.inputs.seeds.unwrap_or(1);
    let mut results = Vec::new();
    for k in 0..seeds {
        let alignment = alignment(bench, &profile, bench.seed().wrapping_add(k));
        let mut report = |what: &str, share: f64| {
            let what = format!("seed {} of {seeds}, {what}", k + 1);
            (bench.progress)(&what, (k as f64 + share) / seeds as f64);
        };
        let mut one = SeedResult::of(
            &alignment,
            name,
            &profile.name,
            &bench.inputs.safe_delays,
            &mut report,
        )?;
        if k > 0 {
            // Only the first seed is drawn; the moments of 1000 seeds would take gigabytes.
            one.moments = Vec::new();
        }
        results.push(one);
    }
    let value = combined(&results, name, &profile.name, bench.seed());
    let moments = &results[0].moments;
    let panels = alignment_panels(moments, name);
    Ok(Outcome {
        caption: format!(
            "Two sites align a part over the network {}, compensation {name}: the distance between the \
             positions they show for one tool at one time{}.",
            profile.name,
            match name {
                "none" => "",
                "predicted" => ", and the server's prediction horizon",
                _ => ", and the playout delay",
            },
        ),
        figures: value,
        charts: vec![(
            format!("atc-{name}"),
            chart(&format!("alignment, compensation {name}"), panels),
        )],
        tables: vec![(format!("atc-{name}"), table(moments))],
        ..Outcome::default()
    })
}

/// Time from a motion to its view at the other site: the network delay without compensation, the playout
/// delay with it.
pub(super) fn transmission(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let (profile, [without, with]) = both(bench)?;
    let age = |moments: &[Moment]| -> Vec<(f64, f64)> {
        moments.iter().map(|m| (m.time_s, m.age_ms)).collect()
    };
    let delay: Vec<_> = with.iter().map(|m| (m.time_s, m.delay_ms)).collect();
    let (age, mean) = (age(&without), |v: &[(f64, f64)]| {
        v.iter().map(|p| p.1).sum::<f64>() / v.len().max(1) as f64
    });
    let spread = |v: &[(f64, f64)]| {
        let m = mean(v);
        (v.iter().map(|p| (p.1 - m).powi(2)).sum::<f64>() / v.len().max(1) as f64).sqrt()
    };
    let figures = json!({
        "profile": profile.name,
        "seed": bench.seed(),
        "without_ms": { "mean": mean(&age), "deviation": spread(&age) },
        "with_ms": { "mean": mean(&delay), "deviation": spread(&delay) },
    });
    let lines = [
        Line::new("without compensation", ORANGE, first_seconds(&age)),
        Line::new("with", BLUE, first_seconds(&delay)),
    ];
    let panel_title = "delay of the view at the other site";
    let panels = vec![Panel::new(
        panel_title,
        "age of the shown sample / ms",
        lines,
    )];
    Ok(Outcome {
        caption: format!(
            "Age of the newest sample at the other site over the network {}, and of the shown sample under \
             adaptive compensation; the first {DRAWN_S} s.",
            profile.name
        ),
        figures,
        charts: vec![(
            "transmission".to_owned(),
            chart("transmission time", panels),
        )],
        tables: vec![("transmission".to_owned(), table(&with))],
        ..Outcome::default()
    })
}

/// Jitter of a tool at the other site: the second difference of the shown position over 1 ms.
pub(super) fn jitter(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let (profile, [without, with]) = both(bench)?;
    let (without, with) = (shaking(&without), shaking(&with));
    let rms = |v: &[(f64, f64)]| {
        (v.iter().map(|p| p.1 * p.1).sum::<f64>() / v.len().max(1) as f64).sqrt()
    };
    let figures = json!({
        "profile": profile.name,
        "seed": bench.seed(),
        "without_um": rms(&without),
        "with_um": rms(&with),
    });
    let without_line = Line::new("shaking", ORANGE, first_seconds(&without));
    let with_line = Line::new("shaking", BLUE, first_seconds(&with));
    let panels = vec![
        Panel::new(
            "without compensation",
            "second difference / µm",
            [without_line],
        ),
        Panel::new(
            "with adaptive compensation",
            "second difference / µm",
            [with_line],
        ),
    ];
    Ok(Outcome {
        caption: format!(
            "Jitter of the other site's tool (second difference of the shown position over 1 ms) over the \
             network {}.",
            profile.name
        ),
        figures,
        charts: vec![("jitter".to_owned(), chart("jitter of a shown tool", panels))],
        ..Outcome::default()
    })
}

/// The network, and the moments without compensation and with the default rule.
fn both(bench: &mut Bench<'_>) -> Result<(Profile, [Vec<Moment>; 2]), String> {
    let profile = bench.profile_or(PROFILE)?;
    let alignment = alignment(bench, &profile, bench.seed());
    (bench.progress)("aligning", 0.0);
    refuse_silence(&alignment, &profile.name)?;
    let moments = [Mode::None, Mode::Adaptive].map(|mode| alignment.moments(mode));
    Ok((profile, moments))
}

fn first_seconds(course: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let until = course.first().map_or(0.0, |p| p.0) + DRAWN_S;
    (course.iter().copied())
        .take_while(|p| p.0 < until)
        .collect()
}

/// Second differences of the first tool's position at the other site, micrometres.
fn shaking(moments: &[Moment]) -> Vec<(f64, f64)> {
    let jerked = moments.windows(3).map(|w| {
        let [a, b, c] = [w[0].first[1], w[1].first[1], w[2].first[1]];
        let square = (0..3)
            .map(|k| (a[k] - 2.0 * b[k] + c[k]).powi(2))
            .sum::<f64>();
        (w[1].time_s, square.sqrt() * 1e6)
    });
    jerked.collect()
}

/// Panels of the disagreement and of the delay or prediction horizon, if any.
fn alignment_panels(moments: &[Moment], name: &str) -> Vec<Panel> {
    let line = |name: &str, colour, of: fn(&Moment) -> f64| {
        Line::new(name, colour, moments.iter().map(|m| (m.time_s, of(m))))
    };
    let disagreement = line("disagreement", ORANGE, Moment::apart_mm);
    let title = "disagreement of the two sites";
    let mut panels = vec![Panel::new(title, "distance / mm", [disagreement])];
    match name {
        "none" => {}
        "predicted" => {
            let horizon = line("A", BLUE, |m| m.ahead_ms);
            let title = "horizon of the server's prediction";
            panels.push(Panel::new(title, "ahead / ms", [horizon]));
        }
        _ => {
            let delay = line("D", BLUE, |m| m.delay_ms);
            panels.push(Panel::new("playout delay", "delay / ms", [delay]));
        }
    }
    panels
}

fn chart(title: &str, panels: Vec<Panel>) -> Chart {
    Chart::new(title, "session time / s", panels)
}

fn table(moments: &[Moment]) -> Table {
    let mut table = Table::new("time_s,disagreement_mm,delay_ms,age_ms");
    for m in moments.iter().step_by(10) {
        table.rows.push(vec![
            format!("{:.3}", m.time_s),
            format!("{:.5}", m.apart_mm()),
            format!("{:.3}", m.delay_ms),
            format!("{:.3}", m.age_ms),
        ]);
    }
    table
}
