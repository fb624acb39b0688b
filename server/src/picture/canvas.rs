//! A sheet of pixels to draw on.

use std::convert::Infallible;

use embedded_graphics::Drawable;
use embedded_graphics::Pixel;
use embedded_graphics::draw_target::DrawTarget;
use embedded_graphics::geometry::{Dimensions, Point as PixelPoint, Size};
use embedded_graphics::mono_font::iso_8859_1::{FONT_8X13, FONT_9X15_BOLD, FONT_10X20};
use embedded_graphics::mono_font::{MonoFont, MonoTextStyle};
use embedded_graphics::pixelcolor::{Rgb888, RgbColor};
use embedded_graphics::primitives::Rectangle;
use embedded_graphics::text::{Baseline, Text};
use tiny_skia::{Color, FillRule, Paint, PathBuilder, Pixmap, Rect, Stroke, Transform};

use super::colour::{Colour, PAPER};

/// Sizes of letters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Letters {
    Small,
    Bold,
    Large,
}

impl Letters {
    fn font(self) -> &'static MonoFont<'static> {
        match self {
            Self::Small => &FONT_8X13,
            Self::Bold => &FONT_9X15_BOLD,
            Self::Large => &FONT_10X20,
        }
    }

    /// Pixels from one letter to the next.
    pub(super) fn width(self) -> f32 {
        let font = self.font();
        (font.character_size.width + font.character_spacing) as f32
    }

    pub(super) fn height(self) -> f32 {
        self.font().character_size.height as f32
    }
}

/// Pixels with the origin at the top left.
pub(super) struct Canvas(Pixmap);

impl Canvas {
    /// A white sheet.
    pub(super) fn new(width: u32, height: u32) -> Result<Self, String> {
        let mut pixels = Pixmap::new(width, height)
            .ok_or_else(|| format!("invalid image size {width} x {height}"))?;
        pixels.fill(colour(PAPER, 1.0));
        Ok(Self(pixels))
    }

    /// Fills a shape without anti-aliasing, so that neighbours leave no seam.
    pub(super) fn fill(&mut self, corners: &[[f32; 2]], with: Colour, opacity: f32) {
        let mut path = PathBuilder::new();
        for (i, [x, y]) in corners.iter().enumerate() {
            if i == 0 {
                path.move_to(*x, *y);
            } else {
                path.line_to(*x, *y);
            }
        }
        path.close();
        if let Some(path) = path.finish() {
            let paint = paint(with, opacity, false);
            let still = Transform::identity();
            self.0
                .fill_path(&path, &paint, FillRule::EvenOdd, still, None);
        }
    }

    pub(super) fn rectangle(&mut self, [x, y]: [f32; 2], size: [f32; 2], with: Colour) {
        if let Some(rectangle) = Rect::from_xywh(x, y, size[0], size[1]) {
            let paint = paint(with, 1.0, false);
            self.0
                .fill_rect(rectangle, &paint, Transform::identity(), None);
        }
    }

    /// Draws lines of one style.
    pub(super) fn lines(
        &mut self,
        lines: impl IntoIterator<Item = [[f32; 2]; 2]>,
        width: f32,
        with: Colour,
        opacity: f32,
    ) {
        let mut path = PathBuilder::new();
        for [from, to] in lines {
            path.move_to(from[0], from[1]);
            path.line_to(to[0], to[1]);
        }
        if let Some(path) = path.finish() {
            let stroke = Stroke {
                width,
                line_cap: tiny_skia::LineCap::Round,
                ..Stroke::default()
            };
            let paint = paint(with, opacity, true);
            self.0
                .stroke_path(&path, &paint, &stroke, Transform::identity(), None);
        }
    }

    /// Draws a filled circle with a light rim.
    pub(super) fn dot(&mut self, [x, y]: [f32; 2], radius: f32, with: Colour) {
        for (radius, with) in [(radius + 1.2, PAPER), (radius, with)] {
            if let Some(path) = PathBuilder::from_circle(x, y, radius) {
                let paint = paint(with, 1.0, true);
                let still = Transform::identity();
                self.0
                    .fill_path(&path, &paint, FillRule::Winding, still, None);
            }
        }
    }

    /// Draws a line of text with its upper left corner at a point.
    pub(super) fn text(&mut self, text: &str, [x, y]: [f32; 2], letters: Letters, with: Colour) {
        let [r, g, b] = with;
        let style = MonoTextStyle::new(letters.font(), Rgb888::new(r, g, b));
        let at = PixelPoint::new(x.round() as i32, y.round() as i32);
        let Ok(_) = Text::with_baseline(text, at, style, Baseline::Top).draw(self);
    }

    /// The picture as PNG.
    pub(super) fn png(&self) -> Result<Vec<u8>, String> {
        self.0.encode_png().map_err(|e| e.to_string())
    }
}

fn colour([r, g, b]: Colour, opacity: f32) -> Color {
    Color::from_rgba8(r, g, b, (opacity * 255.0).round() as u8)
}

fn paint(with: Colour, opacity: f32, soft: bool) -> Paint<'static> {
    let mut paint = Paint::default();
    paint.set_color(colour(with, opacity));
    paint.anti_alias = soft;
    paint
}

impl Dimensions for Canvas {
    fn bounding_box(&self) -> Rectangle {
        let size = Size::new(self.0.width(), self.0.height());
        Rectangle::new(PixelPoint::zero(), size)
    }
}

impl DrawTarget for Canvas {
    type Color = Rgb888;
    type Error = Infallible;

    fn draw_iter<I>(&mut self, pixels: I) -> Result<(), Infallible>
    where
        I: IntoIterator<Item = Pixel<Rgb888>>,
    {
        let (width, height) = (self.0.width() as i32, self.0.height() as i32);
        for Pixel(PixelPoint { x, y }, c) in pixels {
            if (0..width).contains(&x) && (0..height).contains(&y) {
                let solid = tiny_skia::ColorU8::from_rgba(c.r(), c.g(), c.b(), 255).premultiply();
                self.0.pixels_mut()[(x + width * y) as usize] = solid;
            }
        }
        Ok(())
    }
}
