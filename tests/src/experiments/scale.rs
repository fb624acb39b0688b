//! Server load of 1 to 64 participants in one session, a quarter of them in contact.
//!
//! Participants move a tool and solve no tissue; room and solver are the product's. Every row is a [load
//! test](crate::load_test) in virtual time on one thread. With [`REAL`] participants, a server process with
//! QUIC connections is measured too.

use palpate_server::host::TICK_HZ;
use serde_json::{Value, json};

use super::table::Column;
use super::{Bench, Outcome, Table};
use crate::bench::quantile;
use crate::chart::{BLACK, BLUE, Chart, GREEN, GREY, Line, ORANGE, Panel};
use crate::load_test::{LoadTest, LoadTestResult, real, touching};
use crate::simulated_session::host::Round;

const PARTICIPANTS: [usize; 7] = [1, 2, 4, 8, 16, 32, 64];

/// Numbers of participants with a server process: the required number, and the maximum number of seats.
const REAL: [usize; 2] = [32, 64];

/// Number of participants whose ticks must fit the period.
const ASKED: usize = 32;
const SECONDS: f64 = 5.0;

/// Minimum delay of a late tick's start, ms: one step of virtual time, a thirtieth of the period.
const LATE_MS: f64 = 1.0;

fn shares(values: &[f64]) -> Value {
    json!({
        "p50": quantile(values, 0.5),
        "p99": quantile(values, 0.99),
        "max": quantile(values, 1.0),
    })
}

fn row(n: usize, result: &LoadTestResult) -> Value {
    let period_ms = 1e3 / f64::from(TICK_HZ);
    let rounds = &result.rounds;
    let ms = |of: fn(&Round) -> i64| -> Vec<f64> {
        rounds.iter().map(|r| of(r) as f64 * 1e-3).collect()
    };
    let tick = ms(|r| r.tick_us);
    let room = ms(|r| r.room_us);
    let late = ms(|r| r.late_us);
    let all = ms(|r| r.decode_us + r.tick_us + r.fan_out_us);
    let residual: Vec<f64> = rounds.iter().map(|r| r.residual).collect();
    let kbit = |bytes: u64| bytes as f64 * 8e-3 / result.seconds / n as f64;
    let late_ticks = late.iter().filter(|ms| **ms > LATE_MS).count();
    let p99 = quantile(&tick, 0.99);
    json!({
        "participants": n,
        "touching": touching(n),
        "period_ms": period_ms,
        "ticks": rounds.len(),
        "tick_ms": shares(&tick),
        "room_ms": shares(&room),
        "decode_ms": shares(&ms(|r| r.decode_us)),
        "fan_out_ms": shares(&ms(|r| r.fan_out_us)),
        "all_ms": shares(&all),
        "late_ms": shares(&late),
        "late_ticks": late_ticks,
        "iterations_p50": quantile(&rounds.iter().map(|r| r.iterations as f64).collect::<Vec<_>>(), 0.5),
        "residual": shares(&residual),
        "kbit_s": { "up": kbit(result.bytes[0]), "down": kbit(result.bytes[1]) },
        "troubles": result.troubles,
        "ok": p99 < period_ms && result.troubles.is_empty() && !rounds.is_empty(),
    })
}

pub(super) fn run(bench: &mut Bench<'_>) -> Result<Outcome, String> {
    let model = bench.model_or_block([40, 40, 10]);
    let profile = bench.profile_or("metro")?;
    let mut rows = Vec::new();
    for n in PARTICIPANTS {
        let load_test = LoadTest {
            model: &model,
            participants: n,
            profile: &profile,
            seed: bench.seed(),
            seconds: SECONDS,
            tick_hz: TICK_HZ,
        };
        let result = load_test.run(|done| (bench.progress)(&format!("{n} participants"), done))?;
        rows.push(row(n, &result));
    }
    let mut processes = Vec::new();
    for n in REAL {
        (bench.progress)(&format!("{n} participants of a server process"), 0.0);
        let real = real::Real {
            model: &model,
            participants: n,
            seed: bench.seed(),
            seconds: SECONDS,
            dir: bench.dir,
        };
        processes.push(json!(real.run()?));
    }
    let asked = rows.iter().find(|r| r["participants"] == json!(ASKED));
    let missed = asked.map_or_else(Vec::new, missed);
    Ok(Outcome {
        caption: format!(
            "A quarter of the participants palpates {} nodes, the others move their tools through the air; \
             only the server solves. Work per tick is CPU time of one thread: the solver (tick), input \
             (decode), output (fan_out) and their sum (all). Bandwidth is per participant. The first table \
             is in virtual time. In the second, each participant has a QUIC connection to a server process \
             and shares the machine with it.",
            model.nodes.len()
        ),
        charts: vec![("scale".to_owned(), chart(&rows))],
        tables: vec![
            ("scale".to_owned(), Table::of_objects(&rows, COLUMNS)),
            (
                "scale-processes".to_owned(),
                Table::of_objects(&processes, PROCESS_COLUMNS),
            ),
        ],
        figures: json!({
            "experiment": "scale",
            "nodes": model.nodes.len(),
            "network": profile.name,
            "rows": rows,
            "processes": processes,
            "ok": missed.is_empty(),
            "missed": missed,
        }),
        ..Outcome::default()
    })
}

fn missed(row: &Value) -> Vec<String> {
    let (p99, period) = (
        number(row, &["tick_ms", "p99"]),
        number(row, &["period_ms"]),
    );
    let mut missed = Vec::new();
    if row["ticks"] == json!(0) {
        missed.push(format!("{ASKED} participants: no tick was measured"));
    } else if p99.is_nan() || p99 >= period {
        missed.push(format!(
            "{ASKED} participants: the 99th percentile of the tick is {p99:.1} ms, the limit is {period:.1} ms"
        ));
    }
    for trouble in row["troubles"].as_array().into_iter().flatten().take(1) {
        missed.push(format!("{ASKED} participants: {trouble}"));
    }
    missed
}

fn number(row: &Value, path: &[&str]) -> f64 {
    let found = path.iter().fold(row, |v, key| &v[*key]);
    found.as_f64().unwrap_or(f64::NAN)
}

fn chart(rows: &[Value]) -> Chart {
    let over = |path: &[&str]| -> Vec<(f64, f64)> {
        let point = |r: &Value| (number(r, &["participants"]), number(r, path));
        rows.iter().map(point).collect()
    };
    let work = [
        Line::new("tick", BLUE, over(&["tick_ms", "p99"])),
        Line::new("decode", GREEN, over(&["decode_ms", "p99"])),
        Line::new("fan-out", ORANGE, over(&["fan_out_ms", "p99"])),
        Line::new("total", BLACK, over(&["all_ms", "p99"])),
        Line::new("period", GREY, over(&["period_ms"])),
    ];
    let bandwidth = [
        Line::new("up", BLUE, over(&["kbit_s", "up"])),
        Line::new("down", ORANGE, over(&["kbit_s", "down"])),
    ];
    let work_title = "CPU time on one thread, 99th percentile";
    let bandwidth_title = "Bandwidth of one participant, without QUIC overhead";
    let panels = vec![
        Panel::new(work_title, "time per tick (ms)", work),
        Panel::new(bandwidth_title, "rate (kbit/s)", bandwidth),
    ];
    let title = "Server load against the number of participants";
    Chart::new(title, "participants", panels)
}

const COLUMNS: &[Column] = &[
    ("participants", "participants", 1.0),
    ("touching", "touching", 1.0),
    ("period_ms", "period_ms", 1.0),
    ("tick_p50_ms", "tick_ms.p50", 1.0),
    ("tick_p99_ms", "tick_ms.p99", 1.0),
    ("tick_max_ms", "tick_ms.max", 1.0),
    ("decode_p99_ms", "decode_ms.p99", 1.0),
    ("fan_out_p99_ms", "fan_out_ms.p99", 1.0),
    ("all_p99_ms", "all_ms.p99", 1.0),
    ("late_p99_ms", "late_ms.p99", 1.0),
    ("late_ticks", "late_ticks", 1.0),
    ("up_kbit_s", "kbit_s.up", 1.0),
    ("down_kbit_s", "kbit_s.down", 1.0),
    ("ok", "ok", 1.0),
];

const PROCESS_COLUMNS: &[Column] = &[
    ("participants", "participants", 1.0),
    ("touching", "touching", 1.0),
    ("period_ms", "period_ms", 1.0),
    ("tick_p50_ms", "tick_ms.p50", 1.0),
    ("tick_p99_ms", "tick_ms.p99", 1.0),
    ("late_p99_ms", "late_ms.p99", 1.0),
    ("room_cores", "room_cores", 1.0),
    ("network_cores", "network_cores", 1.0),
    ("member_cores", "member_cores", 1.0),
    ("memory_mb", "memory_mb", 1.0),
    ("datagrams_skipped", "datagrams_skipped", 1.0),
    ("up_kbit_s", "up_kbit_s", 1.0),
    ("down_kbit_s", "down_kbit_s", 1.0),
    ("ok", "ok", 1.0),
];
