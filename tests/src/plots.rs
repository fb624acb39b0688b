//! Plots of a report.

use crate::chart::{BLUE, Chart, GREEN, GREY, Line, Mark, ORANGE, PURPLE, Panel, Scale};
use crate::disagreement::CoursePoint;
use crate::force_error::{ForcePoint, norm};

/// Forces of one trainee.
#[derive(Debug, Clone)]
pub struct Felt<'a> {
    /// The name.
    pub name: &'a str,
    /// In the session, over the time of the script.
    pub session: &'a [ForcePoint],
    /// Without a network; empty without a reference.
    pub reference: &'a [ForcePoint],
    /// Begins and ends of dropouts, seconds of script.
    pub dropouts: &'a [(f64, f64)],
}

/// Force over time of every trainee, with the reference. `marks` are in seconds of script.
pub fn forces(felt: &[Felt<'_>], marks: Vec<Mark>) -> Chart {
    let colours = [BLUE, ORANGE, GREEN];
    let panel = |(i, f): (usize, &Felt<'_>)| {
        let line = |name: &str, colour, dashed, points: &[ForcePoint]| Line {
            name: name.to_owned(),
            colour,
            dashed,
            points: points.iter().map(|p| (p.t_s, norm(p.force_n))).collect(),
        };
        Panel {
            title: format!("Force on the tool of the {}", f.name),
            y_label: "force (N)".to_owned(),
            lines: vec![
                line("in the session", colours[i % 3], false, f.session),
                // Dashed and on top, so that both curves stay visible where they coincide.
                line("without a network", GREY, true, f.reference),
                dropouts(f),
            ]
            .into_iter()
            .filter(|l| !l.points.is_empty())
            .collect(),
            scale: Scale::Linear,
        }
    };
    Chart {
        title: "Contact force".to_owned(),
        x_label: "time of the script (s)".to_owned(),
        panels: felt.iter().enumerate().map(panel).collect(),
        marks,
    }
}

/// Dropouts as pulses from zero to the largest force of the reference.
fn dropouts(felt: &Felt<'_>) -> Line {
    let force = felt.reference.iter().map(|p| norm(p.force_n));
    let top = force.fold(0.0, f64::max);
    let pulse = |&(from, to): &(f64, f64)| [(from, 0.0), (from, top), (to, top), (to, 0.0)];
    Line {
        name: format!("dropouts: {}", felt.dropouts.len()),
        colour: PURPLE,
        dashed: false,
        points: felt.dropouts.iter().flat_map(pulse).collect(),
    }
}

/// View disagreement over time. `zero_us` is the start of the script on the monotonic clock.
pub fn views(course: &[CoursePoint], zero_us: i64, marks: Vec<Mark>) -> Chart {
    let line = |name: &str, colour, value: fn(&CoursePoint) -> f64| Line {
        name: name.to_owned(),
        colour,
        dashed: false,
        points: course
            .iter()
            .map(|p| ((p.t_us - zero_us) as f64 * 1e-6, value(p)))
            .collect(),
    };
    Chart {
        title: "Disagreement of views".to_owned(),
        x_label: "time of the script (s)".to_owned(),
        panels: vec![Panel {
            title: "All pairs of participants, in pieces of 0.1 s".to_owned(),
            y_label: "distance (mm)".to_owned(),
            lines: vec![
                line("largest", GREY, |p| p.max_mm),
                line("95th percentile", BLUE, |p| p.p95_mm),
            ],
            scale: Scale::Linear,
        }],
        marks,
    }
}

#[cfg(test)]
mod tests {
    use super::{Felt, forces};
    use crate::force_error::ForcePoint;

    #[test]
    fn dropouts_are_drawn_and_named_where_there_are_any() {
        let course: Vec<ForcePoint> = (0..100)
            .map(|i| ForcePoint {
                t_s: f64::from(i) * 0.01,
                force_n: [0.0, 0.0, 1.0],
                ..ForcePoint::default()
            })
            .collect();
        let svg = |dropouts: &[(f64, f64)]| {
            let felt = Felt {
                name: "holder",
                session: &course,
                reference: &course,
                dropouts,
            };
            forces(&[felt], Vec::new()).to_svg()
        };
        assert!(svg(&[(0.2, 0.3), (0.5, 0.6)]).contains("dropouts: 2"));
        assert!(!svg(&[]).contains("dropouts"));
    }
}
