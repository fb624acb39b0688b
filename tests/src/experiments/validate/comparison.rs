//! A quantity of a specimen at several spacings beside its reference value.

use serde_json::{Value, json};

use super::specimen::Specimen;

/// Largest error at the finest spacing.
pub(super) const LIMIT_PERCENT: f64 = 3.0;
/// Orders of convergence between which one is looked for.
const ORDERS: [f64; 2] = [0.2, 6.0];

/// A quantity at one spacing.
#[derive(Debug, Clone)]
pub(super) struct Run {
    pub(super) spacing_m: f64,
    pub(super) nodes: usize,
    pub(super) iterations: usize,
    pub(super) residual: f64,
    pub(super) is_converged: bool,
    pub(super) measured: f64,
}

/// A quantity with its reference, and runs from the coarsest spacing on.
#[derive(Debug, Clone)]
pub(super) struct Case {
    pub(super) name: &'static str,
    pub(super) poisson: f64,
    /// Quantity and unit.
    pub(super) quantity: &'static str,
    pub(super) reference: &'static str,
    pub(super) expected: f64,
    /// The length that the lattice has to resolve, with its name.
    pub(super) length: (&'static str, f64),
    pub(super) runs: Vec<Run>,
}

impl Case {
    pub(super) fn add(&mut self, specimen: &Specimen, measured: f64) {
        let report = specimen.tissue.report();
        self.runs.push(Run {
            spacing_m: specimen.spacing_m(),
            nodes: specimen.tissue.topology().node_count(),
            iterations: report.iterations,
            residual: report.residual,
            is_converged: specimen.is_converged(),
            measured,
        });
    }

    pub(super) fn error_percent(&self, measured: f64) -> f64 {
        100.0 * (measured / self.expected - 1.0)
    }

    /// Cells over the length that the lattice has to resolve.
    pub(super) fn cells(&self, run: &Run) -> f64 {
        self.length.1 / run.spacing_m
    }

    pub(super) fn label(&self) -> String {
        format!("{}, Poisson's ratio {}", self.name, self.poisson)
    }

    /// The order of convergence and the extrapolated value of the last three runs. `None` if they do not converge.
    fn richardson(&self) -> Option<[f64; 2]> {
        let runs: &[Run; 3] = self.runs.last_chunk()?;
        extrapolated(std::array::from_fn(|i| {
            (runs[i].spacing_m, runs[i].measured)
        }))
    }

    /// The reason why the finest run misses the limit.
    pub(super) fn missed(&self) -> Option<String> {
        let (last, label) = (self.runs.last()?, self.label());
        if !last.is_converged {
            return Some(format!("{label}: residual {:.1e}", last.residual));
        }
        let error = self.error_percent(last.measured);
        // Written so that a NaN fails.
        let is_met = error.abs() <= LIMIT_PERCENT;
        (!is_met).then(|| {
            format!(
                "{label}, {}: {error:+.1} %, limit {LIMIT_PERCENT} %",
                self.quantity
            )
        })
    }

    pub(super) fn figures(&self) -> Value {
        let runs = self.runs.iter().map(|run| {
            json!({
                "spacing_mm": 1e3 * run.spacing_m,
                "cells": self.cells(run),
                "nodes": run.nodes,
                "iterations": run.iterations,
                "residual": run.residual,
                "measured": run.measured,
                "error_percent": self.error_percent(run.measured),
            })
        });
        let last = self.runs.last().map(|run| run.measured);
        let richardson = self.richardson();
        json!({
            "case": self.name,
            "poisson": self.poisson,
            "quantity": self.quantity,
            "reference": self.reference,
            "expected": self.expected,
            "resolved": self.length.0,
            "cells": self.runs.last().map(|run| self.cells(run)),
            "error_percent": last.map(|m| self.error_percent(m)),
            "order": richardson.map(|r| r[0]),
            "extrapolated_percent": richardson.map(|r| self.error_percent(r[1])),
            "ok": self.missed().is_none(),
            "runs": runs.collect::<Vec<_>>(),
        })
    }
}

/// Order of convergence p and limit m0 of three values of (spacing, m), the coarsest first: m = m0 + c h^p. `None` if
/// they do not converge like that.
fn extrapolated(points: [(f64, f64); 3]) -> Option<[f64; 2]> {
    let [a, b, c] = points;
    let share = (a.1 - b.1) / (b.1 - c.1);
    let drop = |p: f64| {
        let [a, b, c] = points.map(|point| (point.0 / a.0).powf(p));
        (a - b) / (b - c)
    };
    let [mut low, mut high] = ORDERS;
    // The share of the first difference grows with the order.
    if !(drop(low)..drop(high)).contains(&share) {
        return None;
    }
    for _ in 0..50 {
        let middle = 0.5 * (low + high);
        if drop(middle) < share {
            low = middle;
        } else {
            high = middle;
        }
    }
    let ratio = (b.0 / c.0).powf(low);
    Some([low, c.1 + (c.1 - b.1) / (ratio - 1.0)])
}

/// Two forces by finite elements, extrapolated from three meshes with these numbers of cells.
pub(super) fn limits(cells: [f64; 3], meshes: [[f64; 2]; 3]) -> [f64; 2] {
    [0, 1].map(|part| {
        let points = [0, 1, 2].map(|i| (1.0 / cells[i], meshes[i][part]));
        extrapolated(points).map_or(f64::NAN, |found| found[1])
    })
}

/// A curve of the finest specimen beside the reference.
#[derive(Debug, Clone)]
pub(super) struct Curve {
    /// Name of the file.
    pub(super) name: &'static str,
    pub(super) title: &'static str,
    pub(super) axes: [&'static str; 2],
    pub(super) sets: Vec<CurveSet>,
}

/// Points of a curve for one Poisson's ratio.
#[derive(Debug, Clone)]
pub(super) struct CurveSet {
    pub(super) poisson: f64,
    pub(super) measured: Vec<(f64, f64)>,
    pub(super) reference: Vec<(f64, f64)>,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn case(measured: &[(f64, f64)]) -> Case {
        let run = |&(spacing_m, measured): &(f64, f64)| Run {
            spacing_m,
            nodes: 1,
            iterations: 1,
            residual: 0.0,
            is_converged: true,
            measured,
        };
        Case {
            name: "case",
            poisson: 0.25,
            quantity: "force (N)",
            reference: "none",
            expected: 2.0,
            length: ("length", 1.0),
            runs: measured.iter().map(run).collect(),
        }
    }

    #[test]
    fn richardson_finds_order_and_limit_at_unequal_ratios() {
        let law = |h: f64| (h, 2.0 + 0.3 * h.powf(1.7));
        let [order, limit] = case(&[0.5, 0.3, 0.1].map(law)).richardson().unwrap();
        assert!((order - 1.7).abs() < 1e-6 && (limit - 2.0).abs() < 1e-6);
        assert!(
            case(&[(0.4, 2.0), (0.2, 2.1), (0.1, 2.05)])
                .richardson()
                .is_none()
        );
        assert!(case(&[(0.4, 2.1), (0.2, 2.0)]).richardson().is_none());
    }

    #[test]
    fn finest_run_alone_counts_against_the_limit() {
        assert_eq!(case(&[(0.2, 3.0), (0.1, 2.05)]).missed(), None);
        let why = case(&[(0.2, 2.0), (0.1, 1.9)]).missed().unwrap();
        assert!(why.contains("-5.0 %"), "{why}");
        assert!(case(&[(0.1, f64::NAN)]).missed().is_some());
        let mut stalled = case(&[(0.1, 2.0)]);
        stalled.runs[0].is_converged = false;
        assert!(stalled.missed().is_some());
    }
}
