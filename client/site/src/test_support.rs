//! Models and table checks for the tests of this package.

use std::sync::Arc;

use palpate_device::{DeviceCaps, Workspace};
use palpate_tissue::{Material, Model, Vec3, block};

/// A soft block of cells of 4 mm on a pinned base.
pub(crate) fn soft_block(cells: [usize; 3]) -> Arc<Model> {
    let material = Material {
        name: "soft".into(),
        young_pa: 10e3,
        density_kg_m3: 1000.0,
        friction_static: 0.4,
        friction_dynamic: 0.3,
        source: "test".into(),
        ..Material::default()
    };
    Arc::new(block(cells, 4e-3, &material, 1))
}

/// Checks every row of a table of STATES.md: from a state, what happens, to a state. Every state must be reached.
pub(crate) fn check_transitions(
    heading: &str,
    states: &[&str],
    run: impl Fn(&str, &str) -> &'static str,
) {
    let document = include_str!("../../../protocol/STATES.md");
    let section = document.split(&format!("## {heading}\n")).nth(1).unwrap();
    let section = section.split("\n## ").next().unwrap();
    let lines = section.lines().filter(|l| l.starts_with('|')).skip(2);
    let rows: Vec<Vec<&str>> = lines
        .map(|l| l.split('|').map(str::trim).collect())
        .collect();
    for state in states {
        assert!(
            rows.iter().any(|r| r[3] == *state),
            "nothing leads to {state}"
        );
    }
    for row in &rows {
        assert!(states.contains(&row[1]), "there is no state {}", row[1]);
        assert_eq!(run(row[1], row[2]), row[3], "{}, {}", row[1], row[2]);
    }
}

/// A device of three axes that renders 10 N.
pub(crate) fn caps() -> DeviceCaps {
    DeviceCaps {
        name: "test".to_owned(),
        dof_in: 6,
        dof_out: 3,
        workspace: Workspace {
            min: Vec3::repeat(-1.0),
            max: Vec3::repeat(1.0),
        },
        max_force_n: 20.0,
        continuous_force_n: 10.0,
        max_torque_nm: 0.0,
        max_stiffness_n_per_m: 3000.0,
        rate_hz: 1000.0,
    }
}
