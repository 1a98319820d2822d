//! Lens of a frame, as its own fields and those of its file state it.

use std::f64::consts::PI;
use std::path::Path;

use serde::Deserialize;
use serde::de::IgnoredAny;

use crate::capture::distortion::{Distortion, Lens};
use crate::capture::{CaptureError, image_file};
use crate::scene::Intrinsics;

/// Intrinsics, per file or per frame.
#[derive(Deserialize)]
pub(super) struct LensFields {
    camera_model: Option<String>,
    is_fisheye: Option<bool>,
    ftheta_p0: Option<IgnoredAny>,
    latlong: Option<bool>,
    equirectangular: Option<bool>,
    /// Field of view in degrees, unlike the angles below.
    x_fov: Option<f64>,
    y_fov: Option<f64>,
    camera_angle_x: Option<f64>,
    camera_angle_y: Option<f64>,
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    w: Option<f64>,
    h: Option<f64>,
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    k5: Option<f64>,
    k6: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
    /// Distortion k1 to k4, p1 and p2, which replace the separate fields (nerfstudio).
    distortion_params: Option<Vec<f64>>,
}

impl LensFields {
    /// Fields of a frame, with the file's where the frame has none of its own.
    fn or_of(&self, file: &Self) -> Self {
        Self {
            camera_model: self.camera_model.clone().or_else(|| file.camera_model.clone()),
            // A frame's own model has precedence over the file's flag.
            is_fisheye: self.is_fisheye.or(file.is_fisheye.filter(|_| self.camera_model.is_none())),
            ftheta_p0: self.ftheta_p0.or(file.ftheta_p0),
            latlong: self.latlong.or(file.latlong),
            equirectangular: self.equirectangular.or(file.equirectangular),
            x_fov: self.x_fov.or(file.x_fov),
            y_fov: self.y_fov.or(file.y_fov),
            camera_angle_x: self.camera_angle_x.or(file.camera_angle_x),
            camera_angle_y: self.camera_angle_y.or(file.camera_angle_y),
            fl_x: self.fl_x.or(file.fl_x),
            fl_y: self.fl_y.or(file.fl_y),
            cx: self.cx.or(file.cx),
            cy: self.cy.or(file.cy),
            w: self.w.or(file.w),
            h: self.h.or(file.h),
            k1: self.k1.or(file.k1),
            k2: self.k2.or(file.k2),
            k3: self.k3.or(file.k3),
            k4: self.k4.or(file.k4),
            k5: self.k5.or(file.k5),
            k6: self.k6.or(file.k6),
            p1: self.p1.or(file.p1),
            p2: self.p2.or(file.p2),
            distortion_params: self.distortion_params.clone().or_else(|| file.distortion_params.clone()),
        }
    }
}

/// What is stated of the lens of one frame.
pub(super) struct Stated<'a> {
    /// Fields of the frame, and of its file. Only of focal lengths it matters whose they are.
    sources: [&'a LensFields; 2],
    /// Fields of the frame, with the file's where the frame has none of its own.
    fields: LensFields,
    /// The file, and the position of the frame in it.
    path: &'a Path,
    at: &'a str,
}

impl<'a> Stated<'a> {
    pub(super) fn new(frame: &'a LensFields, file: &'a LensFields, path: &'a Path, at: &'a str) -> Self {
        Self { sources: [frame, file], fields: frame.or_of(file), path, at }
    }

    pub(super) fn has_size(&self) -> bool {
        self.fields.w.is_some() && self.fields.h.is_some()
    }

    /// Lens for the image `whole` of the frame, instead of which a smaller `image` may be used.
    pub(super) fn lens(&self, image: &Path, whole: &Path) -> Result<Lens, CaptureError> {
        let (width, height) = self.size(image, whole)?;
        let (w, h) = (f64::from(width), f64::from(height));
        let (fx, fy) = self.focal_lengths((w, h))?;
        let cx = self.fields.cx.unwrap_or(w / 2.0);
        let cy = self.fields.cy.unwrap_or(h / 2.0);
        let intrinsics = Intrinsics { width, height, fx, fy, cx, cy };
        Ok(Lens { intrinsics, distortion: self.distortion()? })
    }

    /// Width and height to which lengths in pixels refer.
    fn size(&self, image: &Path, whole: &Path) -> Result<(u32, u32), CaptureError> {
        let LensFields { w, h, fl_x, fl_y, cx, cy, .. } = self.fields;
        match (w, h) {
            // A float cast saturates; invalid sizes fail the aspect check against the image.
            (Some(w), Some(h)) => Ok((w.round() as u32, h.round() as u32)),
            // Missing images are reported together later, so any size will do here.
            _ if !image.is_file() => Ok((1, 1)),
            _ if whole.is_file() => Ok(image_file::header(whole)?.stored().1),
            // Angles apply to any size, but lengths in pixels only to that of the whole image.
            _ if [fl_x, fl_y, cx, cy].iter().any(Option::is_some) => {
                Err(self.invalid("w and h beside fl_x, because the photographs are missing", "neither"))
            }
            _ => Ok(image_file::header(image)?.stored().1),
        }
    }

    /// Focal lengths, in pixels, for pictures of this size (width, height).
    fn focal_lengths(&self, size: (f64, f64)) -> Result<(f64, f64), CaptureError> {
        for fields in self.sources {
            if let Some(lengths) = self.focal_lengths_in(fields, size)? {
                return Ok(lengths);
            }
        }
        Err(self.invalid("fl_x or camera_angle_x", "neither"))
    }

    /// Those that a file or a frame states, if any.
    fn focal_lengths_in(&self, fields: &LensFields, (w, h): (f64, f64)) -> Result<Option<(f64, f64)>, CaptureError> {
        let x = self.focal_length(w, fields.x_fov, fields.fl_x, fields.camera_angle_x)?;
        let y = self.focal_length(h, fields.y_fov, fields.fl_y, fields.camera_angle_y)?;
        // A value for one axis applies to both, as in instant-ngp.
        Ok(x.or(y).zip(y.or(x)))
    }

    /// Focal length along one axis, along which pictures have `side` pixels, if any of the three fields states it.
    fn focal_length(
        &self,
        side: f64,
        degrees: Option<f64>,
        length: Option<f64>,
        radians: Option<f64>,
    ) -> Result<Option<f64>, CaptureError> {
        match (degrees, length) {
            (Some(degrees), _) => self.of_angle(side, degrees.to_radians()).map(Some),
            (None, Some(_)) => Ok(length),
            (None, None) => radians.map(|radians| self.of_angle(side, radians)).transpose(),
        }
    }

    /// Focal length by which `side` pixels are seen at an angle.
    fn of_angle(&self, side: f64, angle: f64) -> Result<f64, CaptureError> {
        let is_angle = angle > 0.0 && angle < PI;
        is_angle
            .then(|| side / (2.0 * (angle / 2.0).tan()))
            .ok_or_else(|| self.invalid("an angle of view between 0 and π radians", format!("{angle} radians")))
    }

    fn distortion(&self) -> Result<Distortion, CaptureError> {
        let (k, p) = self.coefficients()?;
        if let Some(projection) = self.other_projection() {
            return Err(self.unsupported(projection));
        }
        let is_fisheye = self.fields.is_fisheye.unwrap_or(false);
        let fisheye =
            |[k1, k2, k3, k4, ..]: [f64; 6]| Distortion::Fisheye { k: [k1, k2, k3, k4], p: [0.0; 2], s: [0.0; 2] };
        match self.fields.camera_model.as_deref() {
            None if is_fisheye => Ok(fisheye(k)),
            Some("OPENCV_FISHEYE") => Ok(fisheye(k)),
            None => self.brown(None, k, p),
            Some(
                model @ ("SIMPLE_PINHOLE" | "PINHOLE" | "PERSPECTIVE" | "SIMPLE_RADIAL" | "RADIAL" | "OPENCV"
                | "FULL_OPENCV"),
            ) => {
                if is_fisheye {
                    return Err(self.invalid(format!("no is_fisheye beside camera_model {model}"), "true"));
                }
                self.brown(Some(model), k, p)
            }
            Some(other) => Err(self.unsupported(other)),
        }
    }

    /// Coefficients k1 to k6, and p1 and p2; 0 where none is stated.
    fn coefficients(&self) -> Result<([f64; 6], [f64; 2]), CaptureError> {
        let LensFields { k1, k2, k3, k4, k5, k6, p1, p2, distortion_params, .. } = &self.fields;
        match distortion_params.as_deref() {
            None => Ok(([k1, k2, k3, k4, k5, k6].map(|k| k.unwrap_or(0.0)), [p1, p2].map(|p| p.unwrap_or(0.0)))),
            Some(&[k1, k2, k3, k4, p1, p2]) => Ok(([k1, k2, k3, k4, 0.0, 0.0], [p1, p2])),
            Some(other) => Err(self.invalid("six distortion_params: k1, k2, k3, k4, p1, p2", other.len().to_string())),
        }
    }

    /// Projection that other fields than the camera model ask for.
    fn other_projection(&self) -> Option<&'static str> {
        let LensFields { ftheta_p0, latlong, equirectangular, .. } = &self.fields;
        let asked = [
            ("ftheta", ftheta_p0.is_some()),
            ("latlong", *latlong == Some(true)),
            ("equirectangular", *equirectangular == Some(true)),
        ];
        asked.into_iter().find(|(_, is_asked)| *is_asked).map(|(projection, _)| projection)
    }

    /// Distortion of a lens that is no fisheye.
    fn brown(&self, model: Option<&str>, k: [f64; 6], p: [f64; 2]) -> Result<Distortion, CaptureError> {
        // OpenCV divides by the terms of these coefficients, while other programs multiply r⁸ by k4.
        if model != Some("FULL_OPENCV") {
            let unclear = [("k4", k[3]), ("k5", k[4]), ("k6", k[5])].into_iter().find(|(_, k)| *k != 0.0);
            if let Some((name, value)) = unclear {
                let expected = format!("{name} = 0 without a fisheye lens or camera_model FULL_OPENCV");
                return Err(self.invalid(expected, value.to_string()));
            }
        }
        let has_none = k == [0.0; 6] && p == [0.0; 2];
        Ok(if has_none { Distortion::None } else { Distortion::Brown { k, p } })
    }

    fn unsupported(&self, model: &str) -> CaptureError {
        CaptureError::UnsupportedModel { path: self.path.into(), place: self.at.to_owned(), model: model.into() }
    }

    fn invalid(&self, expected: impl Into<String>, found: impl Into<String>) -> CaptureError {
        CaptureError::invalid(self.path, self.at, expected, found)
    }
}
