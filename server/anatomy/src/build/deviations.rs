//! Warnings about deviations of a model from its input, by the thresholds of the scene.

use super::component_loss::{CRUMB_MM3, ComponentLoss};
use super::contact_change::ContactReport;
use super::{BuildReport, FaultKind, RegionReport, SurfaceFault, SurfaceReport, ThinKind};
use crate::scene::{Scene, Thresholds};

/// Most components of a kind, and most contacts, that are named in warnings; the rest is counted.
const NAMED_MAX: usize = 10;

/// Distance, in spacings, from which a region is reported unless the scene sets one.
const DISTANCE_MAX: f64 = 2.0;

/// Adds the warnings about a report to it. `faulty` are the regions whose input surface overlaps itself, or is inside
/// out or ambiguous in part. Contacts of regions that the scene fuses are intended.
pub(super) fn warn(report: &mut BuildReport, faulty: &[usize], scene: &Scene) {
    let thresholds = &scene.thresholds;
    let mut warnings = Vec::new();
    for (r, region) in report.regions.iter().enumerate() {
        let cause = if faulty.contains(&r) {
            "its input surface is faulty, so repair that first"
        } else if is_thin(report, region) {
            "parts of it are thinner than the spacing"
        } else {
            "use a smaller spacing_mm"
        };
        of_region(region, report.spacing_mm, thresholds, cause, &mut warnings);
    }
    of_components(&report.component_loss, &mut warnings);
    let name = |r: usize| &report.regions[r].name;
    let fused = |contact: &ContactReport| {
        let [a, b] = &contact.regions;
        let mut pairs = scene.fuse.iter();
        pairs.any(|&[p, q]| (name(p), name(q)) == (a, b))
    };
    of_contacts(&report.contacts, thresholds, fused, &mut warnings);
    of_surface(
        report,
        None,
        &report.outer_surface,
        thresholds,
        &mut warnings,
    );
    for region in &report.regions {
        let name = Some(&region.name);
        of_surface(report, name, &region.surface, thresholds, &mut warnings);
    }
    if report.surface_intersections as f64 > thresholds.self_intersections {
        let first = first_fault(report, FaultKind::OtherSurface, |_| true);
        warnings.push(format!(
            "surfaces of different regions pass through each other at {} pairs of triangles{first}; use another \
             spacing_mm",
            report.surface_intersections
        ));
    }
    report.deviations = faulty.len() + warnings.len();
    // No threshold decides on these: pieces of the model and components of the input are counted in different ways, and
    // crumbs may be noise.
    warnings.extend(report.regions.iter().filter_map(of_pieces));
    warnings.extend(report.component_loss.crumbs.iter().map(|crumbs| {
        format!(
            "{} components of region {:?} below {CRUMB_MM3} mm³ each, {:.1} mm³ in all, are lost",
            crumbs.count, crumbs.region, crumbs.volume_mm3
        )
    }));
    report.warnings.append(&mut warnings);
}

/// Whether the report lists a part of the region that is thinner than the spacing.
fn is_thin(report: &BuildReport, region: &RegionReport) -> bool {
    report.thin.parts.iter().any(|part| {
        let thin = [ThinKind::Layer, ThinKind::Crumb, ThinKind::Speck];
        part.region.as_ref() == Some(&region.name) && thin.contains(&part.kind)
    })
}

fn of_region(
    region: &RegionReport,
    spacing_mm: f64,
    thresholds: &Thresholds,
    cause: &str,
    warnings: &mut Vec<String>,
) {
    let name = &region.name;
    if region.input_volume_mm3 <= 0.0 {
        warnings.push(format!(
            "region {name:?} is wholly covered by later regions; nothing of it is in the model"
        ));
        return;
    }
    if region.nodes == 0 {
        warnings.push(format!(
            "region {name:?} has no cell at this spacing: it is thinner than half the spacing everywhere"
        ));
        return;
    }
    let error = 100.0 * (region.volume_mm3 / region.input_volume_mm3 - 1.0);
    if error.abs() > thresholds.volume_percent {
        warnings.push(format!(
            "region {name:?} has {error:+.1} % of its input volume too much or too little; {cause}"
        ));
    }
    if region.dice < thresholds.dice {
        warnings.push(format!(
            "region {name:?} has a Dice coefficient of {:.3} with its input (threshold {}): {:.0} mm³ are in one of \
             the two only, {:.0} % of its volume; {cause}",
            region.dice,
            thresholds.dice,
            region.difference_mm3,
            100.0 * region.difference_part
        ));
    }
    let most = thresholds.distance_mm.unwrap_or(DISTANCE_MAX * spacing_mm);
    let ways = [
        (
            "input",
            "model",
            region.input_distance_max_mm.unwrap_or(0.0),
        ),
        ("model", "input", region.surface_distance_max_mm),
    ];
    for (from, to, distance) in ways.into_iter().filter(|w| w.2 > most) {
        warnings.push(format!(
            "region {name:?}: its surface in the {from} is up to {distance:.1} mm from its surface in the {to} \
             (threshold {most} mm); {cause}"
        ));
    }
}

fn of_pieces(region: &RegionReport) -> Option<String> {
    (region.components > region.input_components + region.input_crumbs_kept).then(|| {
        format!(
            "region {:?} is in {} pieces where its input has {}: it is thinner than the spacing between them",
            region.name, region.components, region.input_components
        )
    })
}

fn of_components(loss: &ComponentLoss, warnings: &mut Vec<String>) {
    for lost in loss.lost.iter().take(NAMED_MAX) {
        warnings.push(format!(
            "{lost} is lost: the model has {:.0} % of it",
            100.0 * lost.kept
        ));
    }
    for merged in loss.merged.iter().take(NAMED_MAX) {
        let [x, y, z] = merged.with_mm;
        warnings.push(format!(
            "{} is joined in the model with the one at ({x:.1}, {y:.1}, {z:.1}) mm",
            merged.component
        ));
    }
    for (listed, more, what) in [
        (loss.lost.len(), loss.lost_more, "lost"),
        (loss.merged.len(), loss.merged_more, "joined with others"),
    ] {
        let more = listed.saturating_sub(NAMED_MAX) + more;
        if more > 0 {
            warnings.push(format!("{more} further components are {what}"));
        }
    }
}

fn of_surface(
    report: &BuildReport,
    region: Option<&String>,
    surface: &SurfaceReport,
    thresholds: &Thresholds,
    warnings: &mut Vec<String>,
) {
    let name = region.map_or_else(
        || "the outer surface".to_owned(),
        |name| format!("the surface of region {name:?}"),
    );
    let first =
        |kind: FaultKind| first_fault(report, kind, |fault| fault.region.as_ref() == region);
    if surface.edges_not_two > 0 {
        warnings.push(format!(
            "{name} is not closed: {} edges do not belong to two triangles{}; use another spacing_mm",
            surface.edges_not_two,
            first(FaultKind::EdgeNotTwo)
        ));
    }
    if surface.self_intersections as f64 > thresholds.self_intersections {
        warnings.push(format!(
            "{name} passes through itself at {} pairs of triangles{}; use another spacing_mm",
            surface.self_intersections,
            first(FaultKind::SelfIntersection)
        ));
    }
}

/// Names the place of the first fault of a kind for which `is_own` holds, if there is one.
fn first_fault(
    report: &BuildReport,
    kind: FaultKind,
    is_own: impl Fn(&SurfaceFault) -> bool,
) -> String {
    let mut faults = report.surface_faults.iter();
    let fault = faults.find(|f| f.kind == kind && is_own(f));
    fault.map_or_else(String::new, |fault| {
        let [x, y, z] = fault.at_mm;
        format!(", the first at ({x:.1}, {y:.1}, {z:.1}) mm")
    })
}

fn of_contacts(
    contacts: &[ContactReport],
    thresholds: &Thresholds,
    fused: impl Fn(&ContactReport) -> bool,
    warnings: &mut Vec<String>,
) {
    let mut named = Vec::new();
    for contact in contacts {
        let [a, b] = &contact.regions;
        let place = |at: Option<[f64; 3]>| {
            at.map_or_else(String::new, |[x, y, z]| {
                format!(" around ({x:.1}, {y:.1}, {z:.1}) mm")
            })
        };
        if contact.created_mm2 > thresholds.contact_mm2 && !fused(contact) {
            let gap = match contact.gap_min_mm {
                Some(gap) => format!("{gap:.2} mm apart at least"),
                None => "farther apart than the spacing".to_owned(),
            };
            named.push(format!(
                "regions {a:?} and {b:?} touch in the model on {:.1} mm²{}, where they are {gap} in the input",
                contact.created_mm2,
                place(contact.created_at_mm)
            ));
        }
        if contact.removed_mm2 > thresholds.contact_mm2 {
            named.push(format!(
                "regions {a:?} and {b:?} touch in the input on {:.1} mm²{}, where they do not in the model",
                contact.removed_mm2,
                place(contact.removed_at_mm)
            ));
        }
    }
    let more = named.len().saturating_sub(NAMED_MAX);
    warnings.extend(named.into_iter().take(NAMED_MAX));
    if more > 0 {
        warnings.push(format!("{more} further contacts were created or removed"));
    }
}
