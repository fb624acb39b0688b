//! The pictures of a report.

use crate::chart::{BLUE, Chart, GREEN, GREY, Line, Mark, ORANGE, Panel, Scale};
use crate::disagreement::CoursePoint;
use crate::force_error::{ForcePoint, norm};

/// One trainee's forces.
#[derive(Debug, Clone)]
pub struct Felt<'a> {
    /// The name.
    pub name: &'a str,
    /// In the session, over the time of the script.
    pub session: &'a [ForcePoint],
    /// Without a network; empty when there is none.
    pub reference: &'a [ForcePoint],
}

/// Force over time of every trainee, with the reference. `marks` in seconds of script.
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
                // On top and with dashes: where the two agree, both are to be seen.
                line("without a network", GREY, true, f.reference),
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

/// View disagreement over time. `zero_us` is the script's start on the monotonic clock.
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
