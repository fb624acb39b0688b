//! Colours of regions: similar to the tissue, and distinguishable where it matters.

use palpate_tissue::Model;

/// Red, green, blue.
pub(super) type Colour = [u8; 3];

pub(super) const INK: Colour = [34, 34, 40];
pub(super) const PALE_INK: Colour = [110, 110, 120];
pub(super) const PAPER: Colour = [255, 255, 255];
pub(super) const POOR: Colour = [255, 140, 0];
pub(super) const INVERTED: Colour = [225, 0, 200];

/// Colours for other materials, in turn.
const OTHERS: [Colour; 8] = [
    [102, 166, 214],
    [140, 198, 120],
    [214, 160, 90],
    [170, 140, 205],
    [110, 190, 180],
    [220, 130, 150],
    [190, 190, 100],
    [150, 150, 160],
];

fn of_material(name: &str) -> Option<Colour> {
    Some(match name {
        "skin" => [238, 190, 170],
        "fat" => [248, 218, 130],
        "muscle" => [196, 88, 76],
        "tendon" => [226, 220, 205],
        "fascia" => [188, 190, 214],
        "bone" => [236, 230, 208],
        "cancellous" => [222, 198, 150],
        "marrow" => [212, 134, 92],
        "cartilage" => [160, 204, 226],
        "vessel" => [200, 40, 70],
        "liver" => [142, 62, 52],
        "spleen" => [122, 56, 100],
        "kidney" => [172, 90, 66],
        "gallbladder" => [112, 152, 74],
        "lung" => [240, 196, 206],
        "foam" => [228, 218, 150],
        "rubber" => [92, 92, 104],
        "abs" => [120, 150, 196],
        "pla" => [132, 184, 150],
        "polycarbonate" => [172, 206, 220],
        _ => return None,
    })
}

/// One colour per region. Regions of one material get shades of its colour.
pub(super) fn of_regions(model: &Model) -> Vec<Colour> {
    let mut others: Vec<&str> = Vec::new();
    let regions = &model.regions;
    (0..regions.len())
        .map(|r| {
            let name = regions[r].material.name.as_str();
            let base = of_material(name).unwrap_or_else(|| {
                let number = others.iter().position(|o| *o == name).unwrap_or_else(|| {
                    others.push(name);
                    others.len() - 1
                });
                OTHERS[number % OTHERS.len()]
            });
            let earlier = regions[..r].iter().filter(|o| o.material.name == name);
            shade(base, earlier.count())
        })
        .collect()
}

/// The `number`th shade of a colour: darker for light colours, lighter for dark ones.
fn shade(base: Colour, number: usize) -> Colour {
    let part = 0.15 * number.min(4) as f64;
    let is_light = base.iter().map(|v| u32::from(*v)).sum::<u32>() > 3 * 128;
    let towards = if is_light { 0.0 } else { 255.0 };
    base.map(|v| (f64::from(v) * (1.0 - part) + towards * part) as u8)
}
