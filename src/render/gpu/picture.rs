//! Pictures as they are read back.

/// A rendered picture in the scene's blending space, row-major from the top.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Colour over the background, not clamped above. `[height·width]`
    pub rgb: Vec<[f32; 3]>,
    /// What is left of the background. `[height·width]`
    pub transmittance: Vec<f32>,
}

impl Picture {
    /// Premultiplied colour and alpha without the `background` that the picture is over. `[height·width]`
    #[must_use]
    pub fn premultiplied(&self, background: [f32; 3]) -> Vec<[f32; 4]> {
        let pixel = |(rgb, &t): (&[f32; 3], &f32)| {
            let color = |c: usize| rgb[c] - t * background[c];
            [color(0), color(1), color(2), 1.0 - t]
        };
        self.rgb.iter().zip(&self.transmittance).map(pixel).collect()
    }
}
