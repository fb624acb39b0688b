//! Cost of the page of a trainee's client: one trainee presses by a script, once without a page and once with one.
//!
//! The reader of the page is no browser, so that the figures contain the work of the client alone.

use std::collections::BTreeSet;
use std::fmt;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use clap::Args;
use palpate_device::Script;
use serde::Serialize;
use tokio::time::timeout;

use super::{Benchmark, OnStage, quantile};
use crate::cpu::{CpuRow, cpu_of};
use crate::demo::pair::{self, NAMES, SETTLE, START_LEAD};
use crate::headless_page::{Arrived, HeadlessPage, PageAddress, Received, wall_ms};
use crate::network::Profile;
use crate::reference::{self, Reference};
use crate::scripts::{SECONDS_MIN, Scripts};
use crate::session::{Hosting, Session, SessionError};
use crate::test_model::TestModel;

/// Longest scripts, s.
const SECONDS_MAX: f64 = 120.0;

/// Period of all checks.
const STEP: Duration = Duration::from_millis(50);

/// The trainee.
const NAME: &str = NAMES[0];

#[derive(Debug, Clone, Args)]
pub struct ViewCost {
    /// A model file (.palp), a scene (.toml), or a sample: thigh, abdominal-wall, leg, handle
    #[arg(long, default_value = "thigh")]
    pub model: String,
    /// Length of the script, s
    #[arg(long, default_value_t = 20.0, value_name = "S")]
    pub seconds: f64,
    /// The network between server and trainee
    #[arg(long, default_value = "lan", value_parser = Profile::parse)]
    pub profile: Profile,
    /// Seed of the packet fates
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
}

/// The figures of one run.
#[derive(Debug, Clone, Default, Serialize)]
pub struct ViewRun {
    /// Error of the force against the same hand without a network, percent rms; `None` without contact.
    pub force_error_percent: Option<f64>,
    /// Ticks of the force loop with an outdated contact model.
    pub stale_ticks: u64,
    /// 99th percentile of the lateness of ticks, µs.
    pub lateness_us_p99: u64,
    /// CPU time of the client.
    pub cpu: CpuRow,
    /// The page; `None` in the run without one.
    pub page: Option<PageFigures>,
}

/// Messages that the page received.
#[derive(Debug, Clone, Default, Serialize)]
pub struct PageFigures {
    pub shapes: usize,
    /// Messages that break the format or the sequence.
    pub broken: usize,
    /// Time from the solve to the arrival, ms.
    pub latency_ms_p50: f64,
    pub latency_ms_p99: f64,
    /// Longest time between two shapes, ms.
    pub longest_gap_ms: f64,
}

#[derive(Debug, Clone, Serialize)]
pub struct ViewCostReport {
    pub nodes: usize,
    pub network: String,
    pub seconds: f64,
    pub without_view: ViewRun,
    pub with_view: ViewRun,
}

impl Benchmark for ViewCost {
    type Report = ViewCostReport;

    fn measure(&self, progress: &mut OnStage<'_>) -> Result<ViewCostReport, String> {
        if !(SECONDS_MIN..=SECONDS_MAX).contains(&self.seconds) {
            return Err(format!(
                "--seconds {} must be from {SECONDS_MIN} to {SECONDS_MAX}",
                self.seconds
            ));
        }
        let scratch = tempfile::tempdir().map_err(|e| format!("no temporary folder: {e}"))?;
        progress("preparing the model");
        let model = TestModel::prepare(&self.model, scratch.path())?;
        let text = Scripts::for_model(&model.model, self.seconds)?
            .holder
            .to_toml();
        let file = scratch.path().join("press.toml");
        std::fs::write(&file, &text).map_err(|e| format!("{}: {e}", file.display()))?;
        // Both sides use the rounded numbers of the file.
        let script = Script::from_toml(&text).map_err(|e| e.to_string())?;
        // A second hand that touches nothing, because the reference has two.
        let apart = script.waypoints()[0].position;
        let idle = Script::resting_probe(apart, script.tool().radius_m);
        let idle = idle.map_err(|e| e.to_string())?;
        let both = [&script, &idle];
        let reference = reference::run(&model.model, both, &[], |share| {
            progress(&format!("computing the reference: {:.0} %", share * 100.0));
            true
        });
        let reference = reference.map_err(|e| e.to_string())?;
        let mut run = |has_view: bool| {
            let which = if has_view { "with" } else { "without" };
            progress(&format!(
                "pressing for {:.0} s {which} a page",
                self.seconds
            ));
            self.run(has_view, &model, &file, scratch.path(), &reference)
        };
        Ok(ViewCostReport {
            nodes: model.model.nodes.len(),
            network: self.profile.name.clone(),
            seconds: self.seconds,
            without_view: run(false)?,
            with_view: run(true)?,
        })
    }
}

impl ViewCost {
    fn run(
        &self,
        has_view: bool,
        model: &TestModel,
        script: &Path,
        dir: &Path,
        reference: &Reference,
    ) -> Result<ViewRun, String> {
        let said = |e: SessionError| e.to_string();
        let executable = std::env::current_exe().map_err(|e| format!("no path: {e}"))?;
        let mut session = Session::start(&Hosting {
            executable: &executable,
            model: &model.file,
            profile: self.profile.clone(),
            seed: self.seed,
            compensation: "adaptive",
            start_when: 1,
            view: None,
            seats: None,
        })
        .map_err(said)?;
        let mut trainee = if has_view {
            session.join_with_view(NAME, "trainee", Some(script), dir)
        } else {
            session.join(NAME, "trainee", Some(script), dir)
        }
        .map_err(said)?;
        trainee.wait_until_in(&|| false).map_err(said)?;
        let began = Instant::now();
        let page = if has_view {
            Some(Reader::start(&trainee.page().map_err(said)?)?)
        } else {
            None
        };
        let end = START_LEAD + Duration::from_secs_f64(self.seconds) + SETTLE;
        while began.elapsed() < end {
            session.server.check_alive().map_err(|e| e.to_string())?;
            trainee.program.check_alive().map_err(|e| e.to_string())?;
            std::thread::sleep(STEP);
        }
        let page = page.map(Reader::stop).transpose()?;
        trainee.program.ask_to_end();
        let result = trainee.leave().map_err(said)?;
        session.end().map_err(said)?;
        let figures = pair::figures(&result, Some(reference), self.seconds);
        Ok(ViewRun {
            force_error_percent: figures.force_error_rms,
            stale_ticks: result.summary.events.stale,
            lateness_us_p99: result.summary.lateness_us.p99,
            cpu: cpu_of("trainee", &result.summary).unwrap_or_default(),
            page,
        })
    }
}

/// A page that reads everything, on a thread of its own.
struct Reader {
    is_over: Arc<AtomicBool>,
    thread: JoinHandle<Result<PageFigures, String>>,
}

impl Reader {
    fn start(url: &str) -> Result<Self, String> {
        let address = PageAddress::parse(url).ok_or_else(|| format!("no page at {url:?}"))?;
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .map_err(|e| format!("the thread of the page could not be started: {e}"))?;
        let is_over = Arc::new(AtomicBool::new(false));
        let over = Arc::clone(&is_over);
        let thread = std::thread::spawn(move || runtime.block_on(read(&address, &over)));
        Ok(Self { is_over, thread })
    }

    fn stop(self) -> Result<PageFigures, String> {
        self.is_over.store(true, Ordering::Relaxed);
        let ended = self.thread.join();
        ended.map_err(|_| "the thread of the page panicked".to_owned())?
    }
}

async fn read(address: &PageAddress, is_over: &AtomicBool) -> Result<PageFigures, String> {
    let joined = HeadlessPage::join(address, NAME, None).await;
    let mut page = joined.map_err(|e| e.to_string())?;
    let mut figures = PageFigures::default();
    let mut latencies = Vec::new();
    let mut newest: Option<Instant> = None;
    while !is_over.load(Ordering::Relaxed) {
        let Ok(received) = timeout(STEP, page.next()).await else {
            continue;
        };
        match received.map_err(|e| e.to_string())? {
            Received::Frame(Arrived::Shape(shape)) => {
                figures.shapes += 1;
                latencies.push(wall_ms() - shape.made_ms);
                if let Some(before) = newest.replace(Instant::now()) {
                    let gap_ms = before.elapsed().as_secs_f64() * 1e3;
                    figures.longest_gap_ms = figures.longest_gap_ms.max(gap_ms);
                }
            }
            Received::Frame(Arrived::Broken(_)) => figures.broken += 1,
            _ => {}
        }
    }
    if figures.shapes == 0 {
        return Err("the page received no shape".to_owned());
    }
    figures.latency_ms_p50 = quantile(&latencies, 0.5);
    figures.latency_ms_p99 = quantile(&latencies, 0.99);
    Ok(figures)
}

impl fmt::Display for ViewCostReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (a, b) = (&self.without_view, &self.with_view);
        writeln!(
            f,
            "one trainee presses for {:.0} s, model of {} nodes, network {}\n",
            self.seconds, self.nodes, self.network
        )?;
        write!(f, "{:<28}{:>12}{:>12}{:>8}", "", "no page", "page", "ratio")?;
        let mut line = |what: &str, digits: usize, [a, b]: [f64; 2]| {
            let ratio = match b / a {
                ratio if ratio.is_finite() => format!("{ratio:.2}"),
                _ => "-".to_owned(),
            };
            write!(f, "\n{what:<28}{a:>12.digits$}{b:>12.digits$}{ratio:>8}")
        };
        let error = |run: &ViewRun| run.force_error_percent.unwrap_or(f64::NAN);
        line("force error, % rms", 2, [error(a), error(b)])?;
        line(
            "stale contact, ticks",
            0,
            [a, b].map(|r| r.stale_ticks as f64),
        )?;
        line(
            "lateness p99, us",
            0,
            [a, b].map(|r| r.lateness_us_p99 as f64),
        )?;
        line("CPU, cores", 3, [a.cpu.cores, b.cpu.cores])?;
        let classes: BTreeSet<&String> = a.cpu.classes.keys().chain(b.cpu.classes.keys()).collect();
        for class in classes {
            let of = |run: &ViewRun| run.cpu.classes.get(class).copied().unwrap_or(0.0);
            line(&format!("  {class}"), 3, [of(a), of(b)])?;
        }
        if let Some(page) = &b.page {
            write!(
                f,
                "\n\npage: {} shapes, {} broken, {:.1} ms after the solve (99 %: {:.1} ms), longest gap {:.0} ms",
                page.shapes,
                page.broken,
                page.latency_ms_p50,
                page.latency_ms_p99,
                page.longest_gap_ms
            )?;
        }
        Ok(())
    }
}
