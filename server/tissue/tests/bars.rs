//! The virtual bars of a build's report: what the built samples show of the moduli that were asked for.

#![allow(clippy::unwrap_used)]

use palpate_tissue::build;
use palpate_tissue::sample::Sample;

#[test]
fn every_sample_shows_its_moduli_where_a_region_is_three_cells_thick() {
    for sample in Sample::ALL {
        let input = sample.input().unwrap();
        let (model, report) = build(&input, &mut |_, _| {}).unwrap();
        let moving = model.regions.iter().filter(|r| !r.pinned);
        assert!(
            moving
                .map(|r| &r.name)
                .eq(report.bars.iter().map(|b| &b.region))
        );
        for bar in &report.bars {
            if bar.cells.into_iter().min() >= Some(3) {
                let error = bar.measured_kpa.unwrap() / bar.expected_kpa - 1.0;
                assert!(error.abs() < 0.05, "{sample}: {bar:?}");
            }
        }
    }
}
