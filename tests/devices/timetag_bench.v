// A host and photons for the time tagger's gateware: commands from a file, replies and data to files.
// The gateware itself (module timetag) is not part of this project; see test_timetag_gateware.py.
`timescale 1ns/1ps

// Stands for the memory of the FPGA's maker: 2048 words, emptied while aclr is 1.
module sample_fifo(aclr, data, rdclk, rdreq, wrclk, wrreq, q, rdempty, wrfull);
input aclr, rdclk, rdreq, wrclk, wrreq;
input [47:0] data;
output reg [47:0] q;
output rdempty, wrfull;
reg [47:0] words [0:2047];
reg [11:0] head = 0, tail = 0;

assign rdempty = (head == tail);
assign wrfull = (tail - head == 12'd2048);
always @(posedge wrclk or posedge aclr)
    if (aclr) tail <= 0;
    else if (wrreq) begin words[tail[10:0]] <= data; tail <= tail + 12'd1; end
always @(posedge rdclk or posedge aclr)
    if (aclr) head <= 0;
    else if (rdreq) begin q <= words[head[10:0]]; head <= head + 12'd1; end
endmodule

module bench;
reg usb_clock = 0, clock = 0;
always #10.4 usb_clock = ~usb_clock;  // 48 MHz
always #3.9 clock = ~clock;  // 128 MHz

reg [7:0] command;
reg is_command = 0;
reg [3:0] strobes = 0;
wire [7:0] data, reply;
wire data_ready, reply_ready, reply_end;

timetag gateware(
    .fx2_clk(usb_clock), .clk(clock), .strobe_in(strobes), .delta_chs(),
    .data_rdy(data_ready), .data(data), .data_ack(data_ready),
    .cmd_wr(is_command), .cmd_in(command),
    .reply_rdy(reply_ready), .reply(reply), .reply_ack(reply_ready), .reply_end(reply_end)
);

integer commands, replies, delivered, kind, value, photon, byte_number;
always @(posedge usb_clock) begin
    if (reply_ready) $fwrite(replies, "%02x\n", reply);
    if (data_ready) $fwrite(delivered, "%02x\n", data);
end

initial begin
    commands = $fopen("commands.txt", "r");
    replies = $fopen("replies.txt", "w");
    delivered = $fopen("delivered.txt", "w");
    #200;
    // "0 HEX": a byte of a command; "1 N": the end of a command and N photons after it
    while ($fscanf(commands, "%d %x", kind, value) == 2) begin
        if (kind == 0) begin
            @(negedge usb_clock) command = value[7:0]; is_command = 1;
            @(negedge usb_clock) is_command = 0;
        end else begin
            #500;
            for (photon = 0; photon < value; photon = photon + 1) begin
                #190 strobes = 4'd1 << (photon % 4);
                #10 strobes = 0;
            end
        end
    end
    #20000;
    $fclose(replies);
    $fclose(delivered);
    $finish;
end
endmodule
