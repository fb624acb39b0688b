//! A tool whose strength fades withdraws from the tissue, and returns with it.

use std::sync::Arc;

use palpate_tissue::{Budget, Form, Material, Reaction, Tissue, Tool, Topology, Vec3, block};

const MM: f64 = 1e-3;
const D: f64 = 4.0 * MM;
const CELLS: [usize; 3] = [16, 12, 8];

fn tissue() -> Tissue {
    let material = Material {
        young_pa: 10e3,
        ..Material::default()
    };
    Tissue::at_rest(Topology::new(Arc::new(block(CELLS, D, &material, 1))))
}

fn step(tissue: &mut Tissue, tools: &[Tool]) -> Vec<Reaction> {
    let report = tissue.step(tools, Budget::new(400, 1e-5));
    assert_eq!(report.ignored_tools, 0);
    report.reactions.clone()
}

/// Lowers tools by 8 mm. Returns them with the forces on them.
fn lowered(tissue: &mut Tissue, tools: &[Tool]) -> (Vec<Tool>, Vec<Vec3>) {
    let mut tools = tools.to_vec();
    let mut forces = Vec::new();
    for _ in 0..16 {
        for tool in &mut tools {
            tool.centre.z -= 0.5 * MM;
        }
        forces = step(tissue, &tools).iter().map(|r| r.force).collect();
    }
    (tools, forces)
}

fn at(x: f64, radius: f64) -> Vec3 {
    Vec3::new(x * D, 6.0 * D, 8.0 * D + radius)
}

#[test]
fn force_fades_with_strength_without_a_step_and_returns() {
    let ball = Tool::ball(1, at(8.0, 6.0 * MM), 6.0 * MM);
    let form = Form::line(Vec3::x() * (-8.0 * MM), Vec3::x() * (8.0 * MM));
    for tool in [ball, Tool { form, ..ball }] {
        let mut tissue = tissue();
        let (tools, forces) = lowered(&mut tissue, &[tool]);
        let full = forces[0].norm();
        let mut last = 1.0;
        let mut force_at = |strength: f64| {
            let tool = Tool {
                strength,
                ..tools[0]
            };
            step(&mut tissue, &[tool])[0].force.norm() / full
        };
        for k in (0..20).rev() {
            let strength = f64::from(k) / 20.0;
            let share = force_at(strength);
            assert!(
                share < last + 1e-3 && last - share < 0.1,
                "{strength}: {share}"
            );
            assert!((share - strength).abs() < 0.05, "{strength}: {share}");
            last = share;
        }
        assert!(last < 0.05, "{last}");
        for k in 1..=20 {
            let share = force_at(f64::from(k) / 20.0);
            assert!(share > last - 1e-3 && share - last < 0.1, "{k}: {share}");
            last = share;
        }
        assert!((last - 1.0).abs() < 0.02, "{last}");
    }
}

#[test]
fn fading_tool_leaves_the_force_on_another_tool() {
    let tools = [4.0, 12.0].map(|x| Tool::ball(x as u32, at(x, 6.0 * MM), 6.0 * MM));
    let mut together = tissue();
    let (mut tools, forces) = lowered(&mut together, &tools);
    for k in (0..20).rev() {
        tools[0].strength = f64::from(k) / 20.0;
        let own = step(&mut together, &tools)[1].force;
        assert!((own - forces[1]).norm() < 0.1 * forces[1].norm(), "{own}");
    }
}

#[test]
fn tool_that_appears_in_the_tissue_enters_it_as_its_strength_grows() {
    let mut there = tissue();
    let (tools, forces) = lowered(&mut there, &[Tool::ball(1, at(8.0, 6.0 * MM), 6.0 * MM)]);
    let mut appearing = tissue();
    let mut last = 0.0;
    for k in 0..=20 {
        let strength = f64::from(k) / 20.0;
        let tool = Tool {
            strength,
            ..tools[0]
        };
        let force = step(&mut appearing, &[tool])[0].force.norm() / forces[0].norm();
        assert!(
            (-1e-3..0.12).contains(&(force - last)),
            "{strength}: {force}"
        );
        last = force;
    }
    assert!((last - 1.0).abs() < 0.02, "{last}");
}
