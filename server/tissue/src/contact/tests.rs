//! Index searches equal a linear scan, after any history.

use std::sync::Arc;

use proptest::prelude::*;

use super::ball::Ball;
use super::contact_sample::weights_of;
use super::surface::{Surface, area_normal, blend, nearest_weights};
use super::surface_index::{SurfaceChange, SurfaceIndex, box_of};
use super::{Contacts, Form, POINT_RADIUS, Tool};
use crate::{BladePoint, CutStroke, Material, Topology, Vec3, block, cut};

const D: f64 = 0.004;
const CELLS: [usize; 3] = [9, 7, 5];

fn topology() -> Topology {
    Topology::new(Arc::new(block(CELLS, D, &Material::default(), 1)))
}

/// A point in or near the block.
fn place() -> impl Strategy<Value = Vec3> {
    (-0.3..1.3, -0.3..1.3, -0.3..1.3).prop_map(|(x, y, z): (f64, f64, f64)| {
        let [a, b, c] = CELLS.map(|n| n as f64 * D);
        Vec3::new(x * a, y * b, z * c)
    })
}

#[derive(Debug, Clone)]
enum Event {
    /// Moves the nodes around a place.
    Deform(Vec3, f64, Vec3),
    Restore,
    Cut(Vec3, Vec3),
    Search(Vec<Ball>),
}

fn event() -> impl Strategy<Value = Event> {
    let by = (-3.0..3.0, -3.0..3.0, -3.0..3.0).prop_map(|(x, y, z)| Vec3::new(x, y, z) * D);
    let ball = (place(), 0.1..3.0).prop_map(|(centre, r): (Vec3, f64)| Ball {
        centre,
        radius: r * D,
    });
    let line = (place(), place()).prop_filter("long enough", |(a, b)| (a - b).norm() > D);
    prop_oneof![
        4 => (place(), 0.5..6.0, by).prop_map(|(at, r, by): (Vec3, f64, Vec3)| {
            Event::Deform(at, r * D, by)
        }),
        1 => Just(Event::Restore),
        1 => line.prop_map(|(a, b)| Event::Cut(a, b)),
        6 => proptest::collection::vec(ball, 1..4).prop_map(Event::Search),
    ]
}

fn deform(topology: &Topology, u: &mut [Vec3], at: Vec3, radius: f64, by: Vec3) {
    for (n, u) in u.iter_mut().enumerate() {
        let away = (topology.rest(n as u32) - at).norm() / radius;
        *u += by * (1.0 - away).max(0.0);
    }
}

fn longest(u: &[Vec3]) -> f64 {
    u.iter().map(Vec3::norm).fold(0.0, f64::max)
}

fn distance(surface: &Surface<'_>, triangle: u32, p: Vec3) -> f64 {
    let corners = surface.corners(triangle);
    (blend(&corners, &nearest_weights(&corners, &p)) - p).norm_squared()
}

/// Compares searches around a ball with a linear scan.
fn compare(surface: &Surface<'_>, ball: &Ball) {
    let all = 0..surface.topology.boundary().triangles.len() as u32;
    let squares: Vec<f64> = all.map(|t| distance(surface, t, ball.centre)).collect();
    let near = surface.near(ball.centre, ball.radius);
    assert!(near.is_sorted(), "the order is that of the numbers");
    for (t, square) in squares.iter().enumerate() {
        let found = near.binary_search(&(t as u32)).is_ok();
        assert!(
            found || *square > ball.radius * ball.radius,
            "{t} is missed"
        );
        let inside = ball.reaches_box(&box_of(surface.corners(t as u32)));
        assert_eq!(found, inside, "{t} by its box");
    }
    let foot = surface.nearest(ball.centre, ball.radius);
    let best = squares.iter().copied().fold(f64::MAX, f64::min);
    let lowest = squares.iter().position(|&s| s == best).map(|t| t as u32);
    let within = best < ball.radius * ball.radius;
    assert_eq!(foot.map(|f| f.triangle), lowest.filter(|_| within));
}

#[test]
fn the_nearest_point_is_found_from_a_few_nanometres_away() {
    let topology = topology();
    let index = SurfaceIndex::new(&topology);
    let surface = Surface {
        topology: &topology,
        u: None,
        index: &index,
    };
    for (t, nodes) in topology.boundary().triangles.iter().enumerate() {
        let corners = nodes.map(|n| topology.rest(n));
        let normal = area_normal(&corners).normalize();
        for k in 1..40 {
            let [a, b] = [0.013 * f64::from(k), 0.021];
            let at = blend(&corners, &[1.0 - a - b, a, b]) + normal * (2.3e-10 * f64::from(k));
            let foot = surface.nearest(at, f64::MAX).unwrap();
            assert!((foot.at - at).norm() < 1e-8, "{t} from {at}");
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..Default::default() })]

    /// Over deformations, cuts and tools that come and go.
    #[test]
    fn a_search_misses_no_triangle_whatever_happened_before(
        events in proptest::collection::vec(event(), 1..16),
    ) {
        let mut topology = topology();
        let mut index = SurfaceIndex::new(&topology);
        let mut u = vec![Vec3::zeros(); topology.node_count()];
        for event in events {
            match event {
                Event::Deform(at, radius, by) => deform(&topology, &mut u, at, radius, by),
                Event::Restore => u.fill(Vec3::zeros()),
                Event::Cut(from, to) => {
                    let point = |tip| BladePoint { tip, axis: Vec3::z(), depth_m: 0.01 };
                    let stroke = CutStroke { points: vec![point(from), point(to)], width_m: 0.0 };
                    if let Ok(outcome) = cut(&mut topology, &stroke) {
                        u.resize(topology.node_count(), Vec3::zeros());
                        index.follow(&topology, &SurfaceChange::of(&topology, &outcome.touched), None);
                    }
                }
                Event::Search(balls) => {
                    index.watch(&topology, &u, longest(&u), &balls);
                    let surface = Surface { topology: &topology, u: Some(&u), index: &index };
                    for ball in &balls {
                        compare(&surface, ball);
                    }
                    // Also outside the watched region.
                    let far = Ball { centre: Vec3::repeat(-3.0 * D), radius: 6.0 * D };
                    compare(&surface, &far);
                    compare(&surface, &Ball { radius: 1.0, ..far });
                }
            }
        }
    }

    /// The contacts of a tool are all samples of the surface in its reach that face it.
    #[test]
    fn contacts_are_those_that_a_look_at_every_sample_finds(
        events in proptest::collection::vec((place(), 0.5..6.0, place(), POINT_RADIUS..5.0), 1..6),
        ends in place(), is_ball in any::<bool>(),
    ) {
        let topology = topology();
        let mut contacts = Contacts::new(&topology);
        let mut u = vec![Vec3::zeros(); topology.node_count()];
        let own = vec![1.0; u.len()];
        for (at, size, centre, radius) in events {
            deform(&topology, &mut u, at, size * D, (centre - at) * 0.3);
            let half = if is_ball { Vec3::zeros() } else { ends };
            let form = Form { half: [half, Vec3::zeros()], ..Form::BALL };
            contacts.begin(&[Tool { form, ..Tool::ball(1, centre, radius * D) }]);
            contacts.gather(&topology, &u, longest(&u), &own, &[]);
            let proxy = &contacts.proxies[0];
            let mut expected = Vec::new();
            for &nodes in &topology.boundary().triangles {
                let corners = nodes.map(|n| topology.rest(n) + u[n as usize]);
                for &weights in weights_of(&corners, radius * D, D) {
                    let v = -proxy.core.towards(&blend(&corners, &weights));
                    let facing = v.dot(&area_normal(&corners)) > 0.0;
                    if facing && v.norm() <= (radius + 0.5) * D + proxy.gap {
                        expected.push((nodes, weights));
                    }
                }
            }
            if !proxy.touching {
                expected.clear();
            }
            let found: Vec<_> = contacts.samples.iter().map(|s| (s.nodes, s.weights)).collect();
            prop_assert_eq!(found, expected);
        }
    }
}

#[test]
fn deformation_far_from_all_tools_is_not_visited() {
    let topology = Topology::new(Arc::new(block([40, 6, 6], D, &Material::default(), 1)));
    let mut index = SurfaceIndex::new(&topology);
    let mut u = vec![Vec3::zeros(); topology.node_count()];
    let far = Vec3::new(0.15, 0.012, 0.024);
    deform(&topology, &mut u, far, 0.02, Vec3::z() * -0.01);
    let ball = Ball {
        centre: Vec3::new(0.01, 0.012, 0.024),
        radius: 0.01,
    };
    index.watch(&topology, &u, longest(&u), &[ball]);
    let watched = index.watched().nodes();
    assert!(!watched.is_empty(), "the tool is at the surface");
    for &node in watched {
        assert_eq!(
            u[node as usize],
            Vec3::zeros(),
            "{node} is far from the tool"
        );
    }
    // A tool that reaches the deformed region finds it.
    index.watch(
        &topology,
        &u,
        longest(&u),
        &[Ball {
            centre: far,
            ..ball
        }],
    );
    let watched = index.watched().nodes().iter();
    assert!(watched.filter(|&&n| u[n as usize].norm() > 0.005).count() > 10);
}

#[test]
fn the_index_takes_a_bounded_number_of_bytes_per_triangle_and_node() {
    let topology = topology();
    let triangles = topology.boundary().triangles.len();
    let mut index = SurfaceIndex::new(&topology);
    let bytes = index.heap_bytes();
    let bound = 180 * triangles + 12 * topology.node_count() + 256;
    assert!(bytes <= bound, "{bytes} of {bound}");
    // Repeatedly watch and deform everything.
    let mut u = vec![Vec3::zeros(); topology.node_count()];
    for i in 0..50 {
        let centre = Vec3::new(0.001 * f64::from(i), 0.01, 0.02);
        deform(&topology, &mut u, centre, 0.02, Vec3::z() * 0.002);
        let ball = Ball {
            centre,
            radius: 0.001 * f64::from(i),
        };
        index.watch(&topology, &u, longest(&u), &[ball]);
    }
    let bytes = index.heap_bytes();
    let bound = bound + 120 * triangles;
    assert!(bytes <= bound, "{bytes} of {bound}");
}

#[test]
fn known_tool_that_jumps_into_tissue_is_placed_on_its_surface() {
    let topology = topology();
    let mut contacts = Contacts::new(&topology);
    let u = vec![Vec3::zeros(); topology.node_count()];
    let own = vec![1.0; u.len()];
    let top = CELLS[2] as f64 * D;
    let middle = Vec3::new(4.5 * D, 3.5 * D, top);
    let half = [Vec3::x() * 3.0 * D, Vec3::y() * 2.0 * D];
    let form = Form { half, ..Form::BALL };
    // From 30 mm above the surface to 4 mm below it in one step: too far for this plate's march.
    for height in [0.03, -0.004] {
        let tool = Tool::ball(1, middle + Vec3::z() * height, 0.3 * D);
        contacts.begin(&[Tool { form, ..tool }]);
        contacts.gather(&topology, &u, 0.0, &own, &[]);
        let proxy = &contacts.proxies[0];
        assert_eq!(proxy.touching, height < 0.0);
        assert!(proxy.at.z >= top, "{} m below", top - proxy.at.z);
    }
}

#[test]
fn tool_that_the_surface_has_passed_through_is_placed_outside_again() {
    let topology = topology();
    let mut contacts = Contacts::new(&topology);
    let own = vec![1.0; topology.node_count()];
    let top = CELLS[2] as f64 * D;
    let tool = Tool::ball(1, Vec3::new(4.5 * D, 3.5 * D, top + 0.8 * D), D);
    let rest = vec![Vec3::zeros(); own.len()];
    contacts.begin(&[tool]);
    contacts.gather(&topology, &rest, 0.0, &own, &[]);
    assert!(contacts.proxies[0].touching);
    let risen = vec![Vec3::z() * 2.5 * D; own.len()];
    contacts.reaction(&topology, &risen, None, 0);
    assert!(!contacts.proxies[0].touching);
    // A tool that stands still is pending, so that the next step is not skipped.
    assert!(contacts.are_proxies_following());
    contacts.begin(&[tool]);
    contacts.gather(&topology, &risen, 2.5 * D, &own, &[]);
    let proxy = &contacts.proxies[0];
    assert!(proxy.touching && !contacts.samples.is_empty());
    assert!(
        proxy.at.z > top + 3.3 * D,
        "{} m above the rest",
        proxy.at.z - top
    );
}
