use std::io::Cursor;

use glam::Quat;
use proptest::prelude::*;

use super::filter::VARIANCE;
use super::layout::FILTER_3D;
use super::*;
use crate::format::activation;
use crate::format::attribute::Scalar;
use crate::format::test_scenes::random_splats;

fn written(splats: &Splats) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("s.ply");
    let report = write(&path, splats).unwrap();
    let content = std::fs::read(&path).unwrap();
    assert_eq!(report.bytes, content.len() as u64);
    content
}

/// Variants of degree 3: 2DGS lacks the third scale, others add a fourth band, and `GaussianAvatars` adds bindings.
#[test]
fn layouts_near_inrias_are_read_with_a_note() {
    let splats = random_splats(2, 3, 5);
    let plain = written(&splats);
    let end = plain.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let header = std::str::from_utf8(&plain[..end]).unwrap();
    let rows: Vec<Vec<f32>> = plain[end..].chunks_exact(62 * 4).map(bytemuck::pod_collect_to_vec).collect();
    let read = |header: &str, rows: Vec<Vec<f32>>| {
        let body: Vec<u8> = rows.concat().iter().flat_map(|v| v.to_le_bytes()).collect();
        let read = parse(Cursor::new([header.as_bytes(), &body].concat()), false).unwrap();
        assert_eq!((read.notes.len(), read.splats.means()), (1, splats.means()), "{:?}", read.notes);
        read
    };
    let flat = header.replace("property float scale_2\n", "");
    let flat = read(&flat, rows.iter().map(|row| [&row[..57], &row[58..]].concat()).collect());
    assert!(flat.notes[0].starts_with("scale_2 is missing, as in files of 2DGS"), "{:?}", flat.notes);
    for (read, written) in flat.splats.log_scales().iter().zip(splats.log_scales()) {
        assert_eq!(*read, Vec3::new(written.x, written.y, 1e-6f32.ln()));
    }
    let names: String = (45..72).map(|i| format!("property float f_rest_{i}\n")).collect();
    let header_of_4 = header.replace("property float opacity", &format!("{names}property float opacity"));
    let more = rows.iter().map(|row| {
        let channels = (0..3).flat_map(|c| [&row[9 + 15 * c..24 + 15 * c], &[7.0; 9]].concat());
        row[..9].iter().copied().chain(channels).chain(row[54..].iter().copied()).collect()
    });
    let of_4 = read(&header_of_4, more.collect());
    assert_eq!((of_4.notes[0].as_str(), of_4.splats.sh()), ("SH bands above degree 3 of 4 are left out", splats.sh()));
    assert!(of_4.attributes.is_empty());
    let bound = header.replace("end_header", "property float binding_0\nend_header");
    let bound = read(&bound, rows.iter().map(|row| [&row[..], &[5.0]].concat()).collect());
    assert!(bound.notes[0].starts_with("binding_0: from GaussianAvatars"), "{:?}", bound.notes);
    assert_eq!(bound.attributes[0].values(), [5.0, 5.0]);
}

/// As its renderer does: the 3D filter is applied to scales and opacities, and the 2D filter is kept for rendering.
#[test]
fn mip_splatting_is_read_as_it_is_seen() {
    let splats = random_splats(9, 1, 5);
    let values = (0..9).map(|i| 0.01 * f64::from(i)).collect();
    let filter = Attribute { name: FILTER_3D.to_owned(), kind: Scalar::F32, values };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("s.ply");
    write_with(&path, &splats, &[filter], PixelFilter::DILATION).unwrap();
    let read = read(&path, &ReadOptions::default()).unwrap();
    assert!(read.pixel_filter == PixelFilter::MIP && read.attributes.is_empty() && read.notes.len() == 1, "{read:?}");
    for i in 0..9 {
        let variance = (0.01 * i as f32).powi(2);
        let [before, after] = [&splats, &read.splats].map(|s| s.log_scales()[i].map(|l| (2.0 * l).exp()));
        assert!((after - before - variance).abs().max_element() < 1e-5 * after.max_element(), "{before} {after}");
        let factor = (before / after).element_product().sqrt();
        let opacity = |s: &Splats| activation::opacity(s.opacity_logits()[i]);
        assert!((opacity(&read.splats) - factor * opacity(&splats)).abs() < 1e-6, "{i}");
    }
}

#[test]
fn what_a_file_has_besides_is_named_and_how_it_is_seen_kept() {
    let splats = random_splats(3, 0, 5);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("s.ply");
    let time = Attribute { name: "scale_t".to_owned(), kind: Scalar::F32, values: vec![1.0, 2.0, 3.0] };
    write_with(&path, &splats, std::slice::from_ref(&time), PixelFilter::MIP).unwrap();
    let content = std::fs::read(&path).unwrap();
    let text = String::from_utf8_lossy(&content);
    assert!(text.contains("\ncomment SplatRenderMode: mip\ncomment Centaur filter variance: 0.1\n"));
    let end = content.windows(10).position(|w| w == b"end_header").unwrap();
    let more = b"element extrinsic 1\nproperty float a\nelement empty 0\nproperty list uchar int b\n";
    let mut content = [&content[..end], more, &content[end..]].concat();
    content.extend(1.0_f32.to_le_bytes());
    let read = parse(Cursor::new(&content), false).unwrap();
    assert_eq!((read.pixel_filter, &read.attributes[..]), (PixelFilter::MIP, std::slice::from_ref(&time)));
    assert_eq!(read.notes, ["`extrinsic`, 1 of it: left out"]);
}

/// Other programs write `SplatRenderMode: mip` for every *antialiased* scene; the last comment counts, as in
/// splat-transform.
#[test]
fn comments_say_how_splats_are_seen() {
    let file = written(&random_splats(2, 0, 5));
    let end = file.windows(14).position(|w| w == b"element vertex").unwrap();
    let with = |comments: &str| {
        let lines: String = comments.split_terminator('|').map(|line| format!("comment {line}\n")).collect();
        parse(Cursor::new([&file[..end], lines.as_bytes(), &file[end..]].concat()), false).unwrap()
    };
    let (usual, mip, wide) = (PixelFilter::DILATION, PixelFilter::MIP, PixelFilter::NORMALIZED_DILATION);
    for (comments, expected, note) in [
        ("", usual, ""),
        ("SplatRenderMode: mip", mip, ""),
        ("splatrendermode:  MIP|Exported from Brush", mip, ""),
        ("SplatRenderMode: mip|Generated by splat-transform", wide, "SplatRenderMode mip, written by neither Brush"),
        ("SplatRenderMode: mip|Centaur filter variance: 0.25", PixelFilter { variance: 0.25, normalized: true }, ""),
        ("SplatRenderMode: mip|Centaur filter variance: NaN", wide, "SplatRenderMode mip, written by neither Brush"),
        ("SplatRenderMode: default|Centaur filter variance: 0.25", usual, ""),
        ("antialiased 1", wide, ""),
        ("antialiased 0", usual, ""),
        ("antialiased 1|SplatRenderMode: default", usual, ""),
        ("Exported from Brush|SplatRenderMode: mip|antialiased 0", usual, ""),
        ("SplatRenderMode: default|Antialiased 1", wide, ""),
        ("antialiased 1|SplatRenderMode: banana", wide, "SplatRenderMode `banana`: not known, left out"),
        ("SplatRenderMode: 2dgs", usual, "SplatRenderMode 2dgs: splats are seen as 3DGS has them"),
    ] {
        let read = with(comments);
        assert_eq!(read.pixel_filter, expected, "{comments}");
        assert_eq!(read.notes.len(), usize::from(!note.is_empty()), "{comments}: {:?}", read.notes);
        assert!(read.notes.iter().all(|said| said.starts_with(note)), "{comments}: {:?}", read.notes);
    }
}

#[test]
fn every_filter_that_keeps_integrals_comes_back() {
    let folder = tempfile::tempdir().unwrap();
    let (path, splats) = (folder.path().join("s.ply"), random_splats(2, 0, 5));
    for variance in [0.1, 0.3, 0.123_456_79, 0.0, 2e-9] {
        let filter = PixelFilter { variance, normalized: true };
        write_with(&path, &splats, &[], filter).unwrap();
        let file = read(&path, &ReadOptions::default()).unwrap();
        assert_eq!((file.pixel_filter, file.notes.len()), (filter, 0));
        compressed::write(&path, &splats, filter).unwrap();
        let file = read(&path, &ReadOptions::default()).unwrap();
        assert_eq!((file.pixel_filter, file.notes.len()), (filter, 0));
        // As in files of earlier versions, and as splat-transform writes all antialiased scenes.
        let content = std::fs::read(&path).unwrap();
        let text = format!("comment {VARIANCE} {variance}\n");
        let at = content.windows(text.len()).position(|w| w == text.as_bytes()).unwrap();
        for (line, expected) in
            [("", PixelFilter::MIP), ("comment Generated by splat-transform 3.2.0\n", PixelFilter::NORMALIZED_DILATION)]
        {
            let file = [&content[..at], line.as_bytes(), &content[at + text.len()..]].concat();
            assert_eq!(parse(Cursor::new(file), false).unwrap().pixel_filter, expected);
        }
    }
}

#[test]
fn normals_and_digits_that_are_lost_are_named() {
    let names = ["x", "y", "z", "nx", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"];
    let notes = |kind: &str, first: &str, second: &str| {
        let properties: String = names.iter().map(|name| format!("property {kind} {name}\n")).collect();
        let text = format!(
            "ply\nformat ascii 1.0\nelement vertex 2\n{properties}property float rot_0\nproperty float rot_1\n\
             property float rot_2\nproperty float rot_3\nend_header\n{first} 0 0 0 0 0 0 0 1 0 0 0\n{second} 0 0 0 0 0 0 0 1 0 0 0\n"
        );
        parse(Cursor::new(text), false).unwrap().notes
    };
    // Half a unit in the last place is 0.016 m at this distance, in a scene of 1 m.
    let far = ["500000.01 0 0 0", "500001.01 0 0 0"];
    let said = notes("double", far[0], far[1]);
    assert_eq!(said, ["double-precision positions are rounded to single precision, by 1.0e-2 at most"]);
    assert!(notes("double", "0.01 0 0 0", "1.01 0 0 0").is_empty());
    assert!(notes("float", far[0], far[1]).is_empty(), "text may have more digits than the value");
    assert_eq!(notes("float", "0 0 0 0", "1 0 0 -1"), ["nx, ny, nz: normals are left out"]);
}

#[test]
fn round_trip_is_exact() {
    for degree in 0..=3 {
        let splats = random_splats(17, degree, u64::from(degree));
        let back = parse_splats(Cursor::new(written(&splats))).unwrap();
        assert_eq!(back.means(), splats.means());
        assert_eq!(back.log_scales(), splats.log_scales());
        assert_eq!(back.opacity_logits(), splats.opacity_logits());
        assert_eq!(back.sh(), splats.sh());
        // `Splats::new` normalises again, which can change the last bit.
        for (a, b) in back.rotations().iter().zip(splats.rotations()) {
            assert!((*a - *b).length() < 2.5e-7, "{a} {b}");
        }
    }
    assert_eq!(parse_splats(Cursor::new(written(&Splats::empty(2)))).unwrap(), Splats::empty(2));
}

#[test]
fn tables_of_one_name_are_read_as_they_follow() {
    let text = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nelement vertex 2\n\
                property float x\nproperty float y\nproperty float z\nelement note 0\nend_header\n7 8\n1 2 3\n4 5 -6\n";
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("s.ply");
    std::fs::write(&path, text).unwrap();
    let (found, is_of_splats) = tables(&path).unwrap();
    let bounds: Vec<_> = found.iter().map(|table| table.bounds).collect();
    assert_eq!(bounds, [None, Some([[1.0, 2.0, -6.0], [4.0, 5.0, 3.0]]), None]);
    assert!(!is_of_splats);
}

#[test]
fn layout_is_inrias() {
    let splats = random_splats(1, 3, 5);
    let bytes = written(&splats);
    let header_end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let header = std::str::from_utf8(&bytes[..header_end]).unwrap();
    let names: Vec<&str> = header.lines().filter_map(|l| l.strip_prefix("property float ")).collect();
    assert_eq!(names.len(), 62);
    assert_eq!(
        (names[3], names[9], names[53], names[54], names[61]),
        ("nx", "f_rest_0", "f_rest_44", "opacity", "rot_3")
    );
    let float = |i: usize| f32::from_le_bytes(bytes[header_end + 4 * i..][..4].try_into().unwrap());
    assert_eq!(float(9 + 15), splats.sh_of(0)[1][1], "f_rest is channel-major: 15 red, 15 green, 15 blue");
    assert_eq!(float(58), splats.rotations()[0].w, "rot_0 is w");
}

#[test]
fn ascii_and_big_endian_with_extra_columns_and_lists() {
    let names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"];
    let properties: String = names.iter().map(|n| format!("property double {n}\n")).collect();
    let header = |format: &str| {
        format!(
            "ply\nformat {format} 1.0\ncomment by hand\nelement face 1\nproperty list uchar int vertex_indices\n\
             element vertex 1\nproperty uchar extra\n{properties}property float rot_0\nproperty float rot_1\n\
             property float rot_2\nproperty float rot_3\nend_header\n"
        )
    };
    let values: [f64; 10] = [1.0, 2.0, 3.0, 0.1, 0.2, 0.3, -1.5, -4.0, -5.0, -6.0];
    let ascii = format!("{}3 0 0 0\n7 {} 2 0 0 0", header("ascii"), values.map(|v| v.to_string()).join(" "));
    let mut big = header("binary_big_endian").into_bytes();
    big.push(3);
    big.extend([0; 12]);
    big.push(7);
    values.iter().for_each(|v| big.extend(v.to_be_bytes()));
    [2.0f32, 0.0, 0.0, 0.0].iter().for_each(|v| big.extend(v.to_be_bytes()));
    for file in [ascii.into_bytes(), big] {
        let splats = parse_splats(Cursor::new(file)).unwrap();
        assert_eq!(splats.means(), [Vec3::new(1.0, 2.0, 3.0)]);
        assert_eq!(splats.sh(), [[0.1, 0.2, 0.3]]);
        assert_eq!(splats.opacity_logits(), [-1.5]);
        assert_eq!(splats.rotations(), [Quat::IDENTITY]);
    }
}

/// Higher bands are counted from 0; what is numbered past them is none of the splat's parameters.
#[test]
fn bands_after_a_gap_are_attributes() {
    let splats = random_splats(2, 1, 5);
    let file = written(&splats);
    let end = file.windows(11).position(|w| w == b"end_header\n").unwrap();
    let header = std::str::from_utf8(&file[..end]).unwrap().replace(" nx\n", " f_rest_10\n");
    let read = parse(Cursor::new([header.as_bytes(), &file[end..]].concat()), false).unwrap();
    let names: Vec<&str> = read.attributes.iter().map(Attribute::name).collect();
    assert_eq!((names, read.splats.sh()), (vec!["f_rest_10"], splats.sh()));
}

#[test]
fn saturated_splats_become_finite() {
    let mut file = written(&random_splats(1, 0, 3));
    let row = file.len() - 17 * 4;
    file[row + 36..row + 40].copy_from_slice(&f32::INFINITY.to_le_bytes());
    file[row + 40..row + 44].copy_from_slice(&f32::NEG_INFINITY.to_le_bytes());
    let splats = parse_splats(Cursor::new(&file)).unwrap();
    assert!((16.0..17.0).contains(&splats.opacity_logits()[0]), "the f32 below 1");
    assert!((-88.0..-87.0).contains(&splats.log_scales()[0].x), "the least normal f32");
    file[row + 36..row + 40].copy_from_slice(&f32::NAN.to_le_bytes());
    assert!(parse_splats(Cursor::new(file)).is_err());
}

#[test]
fn points_with_and_without_colour() {
    let file = b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n\
                 property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n1 2 3 4 5 6\n7 8 9 10 11 12\n";
    assert_eq!(
        parse_points(Cursor::new(file)).unwrap(),
        [(DVec3::new(1.0, 2.0, 3.0), [4, 5, 6]), (DVec3::new(7.0, 8.0, 9.0), [10, 11, 12])]
    );
    let plain = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n\
                  end_header\n1 2 3";
    assert_eq!(parse_points(Cursor::new(plain)).unwrap(), [(DVec3::new(1.0, 2.0, 3.0), [128; 3])]);
}

#[test]
fn messages_name_place_expected_and_found() {
    let message = |bytes: &[u8]| parse_splats(Cursor::new(bytes)).unwrap_err().in_file(Path::new("a.ply")).to_string();
    assert_eq!(message(b"PK\x03\x04"), "a.ply: byte 0: expected a PLY file (starts with `ply`), found something else");
    let mut file = written(&random_splats(3, 0, 1));
    let header = |from: &str, to: &str| {
        let text = String::from_utf8_lossy(&file[..300]).replace(from, to).into_bytes();
        message(&[&text, &file[300..]].concat())
    };
    assert_eq!(
        header("ian 1.0", "ian 2.0"),
        "a.ply: byte 4: expected version 1.0 of the format, found `format binary_little_endian 2.0`"
    );
    let twice = "a.ply: byte 36: expected each property once, found `x` twice";
    assert_eq!(header("property float nx", "property float x "), twice);
    file.truncate(file.len() - 10);
    assert!(
        message(&file).contains("expected 3 rows of `vertex` of at least 68 bytes, found 194 bytes"),
        "{}",
        message(&file)
    );
    assert!(
        message(b"ply\nformat ascii 1.0\nelement vertex 18446744073709551615\nend_header\n").contains("property `x`")
    );
}

#[test]
fn attributes_come_back_under_their_names_and_types() {
    let splats = random_splats(3, 1, 4);
    let attribute =
        |name: &str, kind, values: [f64; 3]| Attribute { name: name.to_owned(), kind, values: values.to_vec() };
    let attributes = vec![
        attribute("label", Scalar::U8, [0.0, 7.0, 255.0]),
        attribute("time", Scalar::F64, [0.1, -2.5e300, f64::MIN_POSITIVE]),
        attribute("shift", Scalar::I16, [-32768.0, 1.0, 32767.0]),
        attribute("confidence", Scalar::F32, [0.25, f64::INFINITY, -1.0]),
    ];
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("s.ply");
    write_with(&path, &splats, &attributes, PixelFilter::DILATION).unwrap();
    let back = read(&path, &ReadOptions::default()).unwrap();
    assert_eq!((&back.attributes, back.dropped), (&attributes, Some(0)));
    assert_eq!(back.splats, splats);

    assert_eq!(attributes[0].gather(&[2, 0]).values(), [255.0, 0.0]);
    let joined = Attribute::join(&[&attributes[2], &attributes[2]]).unwrap();
    assert_eq!((joined.name(), joined.values().len()), ("shift", 6));
    assert!(Attribute::join(&[&attributes[1], &attributes[2]]).is_none());
    assert!(write_with(&path, &random_splats(4, 0, 1), &attributes, PixelFilter::DILATION).is_err());
}

#[test]
fn invalid_rows_are_refused_or_dropped_with_their_attributes() {
    let splats = random_splats(6, 0, 4);
    let order = Attribute { name: "order".to_owned(), kind: Scalar::I32, values: (0..6).map(f64::from).collect() };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("s.ply");
    write_with(&path, &splats, &[order], PixelFilter::DILATION).unwrap();
    let mut file = std::fs::read(&path).unwrap();
    let first_row = file.len() - 6 * 18 * 4;
    // Invalid values of a mean, a colour and an opacity; and a quaternion of zeros.
    for (row, column, value) in [(0, 1, f32::NAN), (2, 6, f32::INFINITY), (3, 9, f32::NAN)] {
        file[first_row + 4 * (18 * row + column)..][..4].copy_from_slice(&value.to_le_bytes());
    }
    file[first_row + 4 * (18 * 5 + 13)..][..16].fill(0);
    assert!(parse(Cursor::new(&file), false).is_err());
    let left = parse(Cursor::new(&file), true).unwrap();
    assert_eq!((left.dropped, left.attributes[0].values()), (Some(4), &[1.0, 4.0][..]));
    assert_eq!(left.splats.means(), [splats.means()[1], splats.means()[4]]);
}

proptest! {
    #[test]
    fn damaged_files_do_not_panic(cut in 0usize..2000, at in 0usize..2000, byte: u8, degree in 0u32..4) {
        let mut file = written(&random_splats(3, degree, 9));
        file.truncate(cut.max(1));
        let at = at % file.len();
        file[at] = byte;
        let _ = parse_splats(Cursor::new(&file));
        let _ = parse_points(Cursor::new(&file));
    }
}
