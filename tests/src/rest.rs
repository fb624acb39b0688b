use crate::{test_model::TestModel, tool_location::ToolLocation};
use palpate_tissue::*;
pub fn run() {
    let name = std::env::args().nth(2).unwrap();
    let apart: f64 = std::env::args().nth(3).unwrap().parse().unwrap();
    let model = TestModel::in_memory(&name, &mut |_: &str| {}).unwrap();
    let base = Tissue::new(model);
    let place = ToolLocation::find(base.topology()).unwrap();
    let depth_max = (place.depth_m * 0.3).min(10e-3);
    println!("{} nodes depth {} spacing {}", base.topology().node_count(), place.depth_m, place.spacing_m);
    let ball = |id: u32, side: f64, depth: f64| {
        let from = place.middle + place.u * (side * apart * 0.5);
        Tool::ball(id, from + place.normal * (8e-3 - depth), 8e-3)
    };
    for cutting in [false, true] {
        for steps in [1, 5, 30] {
            let mut full = base.another();
            if cutting {
                let pts = (0..=40).map(|i| BladePoint { tip: place.surface(0.0, (i as f64 / 40.0 - 0.5) * 0.04).at - place.normal * depth_max, axis: place.normal, depth_m: depth_max + 6e-3 }).collect();
                let stroke = CutStroke { points: pts, width_m: 0.5e-3 };
                let mut p = full.preparer();
                let c = p.prepare(&stroke).unwrap();
                full.succeed(p.repeat(&c));
            }
            let b = depth_max * 0.6;
            let mut all = 0;
            let mut out = String::new();
            for k in 1..=steps {
                let r = full.step(&[ball(2, 1.0, b * k as f64 / steps as f64)], Budget::new(300, 1e-4));
                all += r.iterations;
                if r.residual > 1e-4 { out += &format!(" [{k}: {:.0e}]", r.residual); }
            }
            for (its, tol) in [(300, 1e-4), (300, 1e-6)] {
                let r = full.step(&[ball(2, 1.0, b)], Budget::new(its, tol));
                out += &format!(" | {} it residual {:.1e} force {:.4} N", r.iterations, r.residual, r.reactions[0].force.norm());
            }
            println!("cut {cutting} in {steps} steps: {all} iterations{out}");
        }
    }
}
