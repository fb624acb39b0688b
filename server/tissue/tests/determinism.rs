//! The same steps give the same bits on any number of threads, with any vector width, in any build.

use std::sync::Arc;

use palpate_tissue::{Budget, Material, Tissue, Tool, Topology, Vec3, block};

/// Hash of a press into a block of 14 thousand cells with a volume term and stiffening springs. It changes only
/// with the force law or the solver, and then on every machine.
const GOLDEN: u64 = 0x7951_b513_6618_550b;

fn press(threads: usize) -> u64 {
    let material = Material {
        poisson: 0.35,
        stiffening: 2.0,
        ..Material::default()
    };
    let topology = Topology::new(Arc::new(block([24, 24, 24], 4e-3, &material, 1)));
    let mut tissue = Tissue::at_rest(topology.clone());
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .expect("threads");
    pool.install(|| {
        for step in 1..=3 {
            let tool = Tool::ball(
                1,
                Vec3::new(0.047, 0.05, 0.096 + 0.012 - 1e-3 * f64::from(step)),
                0.012,
            );
            // A small tolerance refines every brick, so that the threads have work to share.
            tissue.step(&[tool], Budget::new(4, 1e-6));
        }
    });
    tissue.shape().hash()
}

#[test]
fn press_is_bit_equal_on_any_thread_count_and_in_any_build() {
    for threads in [1, 2, 4] {
        assert_eq!(press(threads), GOLDEN, "{:#x} on {threads}", press(threads));
    }
}
