// Exclusive prefix sum over the 256 threads of a workgroup, in two serial levels of 16: four barriers, no subgroups.
// Every thread must call it. `workgroup_total` holds the sum of all values afterwards. Sums saturate.
//#import shared/saturating_add.wgsl

const ROW: u32 = 17u;                   // 16 values and a gap, so that the 16 walkers hit different banks

var<workgroup> row_values: array<u32, 272>;
var<workgroup> row_sums: array<u32, 16>;
var<workgroup> workgroup_total: u32;

fn workgroup_scan(thread: u32, value: u32) -> u32 {
    let row = thread / 16u;
    let place = row * ROW + thread % 16u;
    row_values[place] = value;
    workgroupBarrier();
    if thread < 16u {
        var sum = 0u;
        //#for i in 0..16
        let v$i = row_values[thread * ROW + $iu];
        row_values[thread * ROW + $iu] = sum;
        sum = saturating_add(sum, v$i);
        //#end
        row_sums[thread] = sum;
    }
    workgroupBarrier();
    if thread == 0u {
        var sum = 0u;
        //#for i in 0..16
        let r$i = row_sums[$i];
        row_sums[$i] = sum;
        sum = saturating_add(sum, r$i);
        //#end
        workgroup_total = sum;
    }
    workgroupBarrier();
    let before = saturating_add(row_sums[row], row_values[place]);
    workgroupBarrier();                 // the arrays may be used again
    return before;
}
